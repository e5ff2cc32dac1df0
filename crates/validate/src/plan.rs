//! Runs cases for several seeds on several threads, and stores their outcomes.

use crate::cases::{Case, cases};
use crate::error::ValidateError;
use crate::kept::{Done, Kept};
use crate::outcome::Outcome;
use crate::report::{CaseReport, Program, Report};
use crate::run::{Length, Records, Run};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

/// Receiver of progress, called from several threads.
pub trait Watch: Sync {
    /// Reports that a run has completed this share of its work (0 to 1).
    fn advanced(&self, case: &Case, seed: u64, share: f64);
    /// Reports the end of a run with its outcome or error. `kept` is `true` if the outcome comes
    /// from the store.
    fn finished(
        &self,
        case: &Case,
        seed: u64,
        result: Result<&Outcome, &ValidateError>,
        kept: bool,
    );
}

/// A [`Watch`] that ignores all progress.
#[derive(Debug, Clone, Copy, Default)]
pub struct Quiet;

impl Watch for Quiet {
    fn advanced(&self, _: &Case, _: u64, _: f64) {}
    fn finished(&self, _: &Case, _: u64, _: Result<&Outcome, &ValidateError>, _: bool) {}
}

/// Cases to be run.
#[derive(Debug)]
pub struct Plan {
    cases: Vec<&'static Case>,
    seeds: Vec<u64>,
    length: Length,
    threads: usize,
    kept: Option<Kept>,
    records: Option<Records>,
    stopped: AtomicBool,
}

type Result1 = Result<Done, ValidateError>;

impl Plan {
    /// Creates a plan that runs each case once per seed, on one thread.
    #[must_use]
    pub fn new(cases: Vec<&'static Case>, seeds: Vec<u64>, length: Length) -> Self {
        Self {
            cases,
            seeds,
            length,
            threads: 1,
            kept: None,
            records: None,
            stopped: AtomicBool::new(false),
        }
    }

    /// Sets the number of cases that run concurrently.
    #[must_use]
    pub fn threads(mut self, threads: usize) -> Self {
        self.threads = threads.max(1);
        self
    }

    /// Stores each outcome in a directory, and reuses stored outcomes with the same mark, so that a
    /// stopped run resumes.
    ///
    /// The mark must change with the program. The report includes stored outcomes of unplanned
    /// cases whatever their mark, so that the page stays complete when only some cases run again.
    #[must_use]
    pub fn keep(mut self, directory: &Path, mark: impl Into<String>) -> Self {
        self.kept = Some(Kept::new(directory, mark.into()));
        self
    }

    /// Sets the records of real structures.
    ///
    /// A case that [needs records](Case::needs_records) fails without them.
    #[must_use]
    pub fn records(mut self, records: Records) -> Self {
        self.records = Some(records);
        self
    }

    /// Asks all runs to stop soon. May be called from another thread.
    pub fn stop(&self) {
        self.stopped.store(true, Ordering::Relaxed);
    }

    /// Runs all cases. The report lists them in their original order, independent of the threads.
    ///
    /// # Errors
    /// Returns an error if an outcome cannot be stored. A case that fails does not stop the others
    /// and appears in the report.
    pub fn run(&self, watch: &dyn Watch) -> Result<Report, ValidateError> {
        if let Some(kept) = &self.kept {
            kept.prepare()?;
        }
        let mut jobs: Vec<(usize, usize)> = Vec::new();
        for seed in 0..self.seeds.len() {
            jobs.extend((0..self.cases.len()).map(|case| (case, seed)));
        }
        // The longest runs start first, so that no thread is left with a long run at the end.
        jobs.sort_by(|a, b| self.cases[b.0].weight.total_cmp(&self.cases[a.0].weight));
        let next = AtomicUsize::new(0);
        let results: Mutex<Vec<Vec<Option<Result1>>>> = Mutex::new(
            self.cases
                .iter()
                .map(|_| self.seeds.iter().map(|_| None).collect())
                .collect(),
        );
        let trouble: Mutex<Option<ValidateError>> = Mutex::new(None);
        std::thread::scope(|scope| {
            for _ in 0..self.threads.min(jobs.len()) {
                scope.spawn(|| {
                    while let Some(&(case, seed)) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
                        match self.one(self.cases[case], self.seeds[seed], watch) {
                            Ok(result) => {
                                lock(&results)[case][seed] = Some(result);
                            }
                            Err(error) => {
                                self.stop();
                                lock(&trouble).get_or_insert(error);
                            }
                        }
                    }
                });
            }
        });
        if let Some(error) = lock(&trouble).take() {
            return Err(error);
        }
        let results = results.into_inner().unwrap_or_else(PoisonError::into_inner);
        let report = self.cases.iter().zip(results).map(|(case, results)| {
            let outcomes = results
                .into_iter()
                .map(|result| result.unwrap_or(Err(ValidateError::Stopped)));
            CaseReport::new(
                case,
                self.seeds.iter().copied().zip(outcomes).collect(),
                Program::This,
            )
        });
        Ok(Report {
            length: self.length,
            cases: report.collect(),
            others: self.others(),
        })
    }

    /// Returns the reports of stored outcomes whose cases are not planned.
    fn others(&self) -> Vec<CaseReport> {
        let Some(kept) = &self.kept else {
            return Vec::new();
        };
        let planned = |case: &Case| self.cases.iter().any(|planned| planned.name == case.name);
        let report = |case: &Case| {
            let runs = kept.read_all(case, self.length);
            let program = if runs.iter().all(|(_, done)| kept.is_own(done)) {
                Program::This
            } else {
                Program::Another
            };
            let outcomes = runs
                .into_iter()
                .map(|(seed, done)| (seed, Ok(done)))
                .collect::<Vec<_>>();
            (!outcomes.is_empty()).then(|| CaseReport::new(case, outcomes, program))
        };
        cases()
            .iter()
            .copied()
            .filter(|case| !planned(case))
            .filter_map(report)
            .collect()
    }

    /// Runs one case for one seed, or returns the stored outcome.
    fn one(
        &self,
        case: &'static Case,
        seed: u64,
        watch: &dyn Watch,
    ) -> Result<Result1, ValidateError> {
        if let Some(done) = self
            .kept
            .as_ref()
            .and_then(|kept| kept.read(case, seed, self.length))
        {
            watch.finished(case, seed, Ok(&done.outcome), true);
            return Ok(Ok(done));
        }
        let advanced = |share: f64| watch.advanced(case, seed, share);
        #[expect(
            clippy::disallowed_methods,
            reason = "the report tells how long each case takes"
        )]
        let start = Instant::now();
        let result = if self.stopped.load(Ordering::Relaxed) {
            Err(ValidateError::Stopped)
        } else {
            (case.run)(&Run {
                seed,
                length: self.length,
                records: self.records.as_ref(),
                advanced: &advanced,
                stopped: &self.stopped,
            })
        };
        watch.finished(case, seed, result.as_ref(), false);
        let mark = self.kept.as_ref().map_or("", Kept::mark);
        let result = result.map(|outcome| Done::new(mark, start.elapsed().as_secs_f64(), outcome));
        if let (Some(kept), Ok(done)) = (&self.kept, &result) {
            kept.write(case, seed, self.length, done)?;
        }
        Ok(result)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::figure::{Figure, Required};

    static RUNS: AtomicUsize = AtomicUsize::new(0);

    fn counted(run: &Run<'_>) -> Result<Outcome, ValidateError> {
        RUNS.fetch_add(1, Ordering::Relaxed);
        seed_as_figure(run)
    }

    fn seed_as_figure(run: &Run<'_>) -> Result<Outcome, ValidateError> {
        let figure = Figure::new("seed", run.seed as f64, Required::AtMost(2.0));
        Ok(Outcome {
            figures: vec![figure],
            ..Outcome::default()
        })
    }

    fn without_result(_: &Run<'_>) -> Result<Outcome, ValidateError> {
        Err(ValidateError::Stopped)
    }

    /// The runs of this case are counted, so only one test may use it.
    static COUNTED: Case = Case {
        name: "test.counted",
        title: "seeds",
        source: "here",
        weight: 1.0,
        run: counted,
    };
    static PLAIN: Case = Case {
        name: "test.plain",
        title: "seeds",
        source: "here",
        weight: 1.0,
        run: seed_as_figure,
    };
    static FAILED: Case = Case {
        name: "test.failed",
        title: "nothing",
        source: "here",
        weight: 2.0,
        run: without_result,
    };

    #[test]
    fn stopped_plan_resumes() {
        let directory = tempfile::tempdir().unwrap();
        let plan = |mark: &str| {
            Plan::new(vec![&COUNTED], vec![1, 2], Length::Quick).keep(directory.path(), mark)
        };
        let first = plan("a").run(&Quiet).unwrap();
        let done = RUNS.load(Ordering::Relaxed);
        assert_eq!(plan("a").run(&Quiet).unwrap(), first);
        assert_eq!(
            RUNS.load(Ordering::Relaxed),
            done,
            "kept outcomes are not made again"
        );
        plan("b").run(&Quiet).unwrap();
        assert_eq!(
            RUNS.load(Ordering::Relaxed),
            done + 2,
            "another program makes them again"
        );
        std::fs::write(
            directory.path().join("test.counted.quick.seed-1.json"),
            "{\"mark\": \"b\", \"fig",
        )
        .unwrap();
        let again = plan("b").run(&Quiet).unwrap();
        assert_eq!(
            again.cases[0].figures, first.cases[0].figures,
            "a file that was cut off is made again"
        );
        assert_eq!(RUNS.load(Ordering::Relaxed), done + 3);
    }

    #[test]
    fn report_of_one_case_keeps_the_stored_results_of_the_others() {
        let directory = tempfile::tempdir().unwrap();
        let vehicle = cases()
            .iter()
            .find(|case| case.name == "kalman.vehicle")
            .unwrap();
        let plan = |case, mark: &str| {
            Plan::new(vec![case], vec![1, 2], Length::Quick).keep(directory.path(), mark)
        };
        let first = plan(vehicle, "a").run(&Quiet).unwrap();
        assert!(first.others.is_empty());
        for (mark, program) in [("a", Program::This), ("b", Program::Another)] {
            let second = plan(&PLAIN, mark).run(&Quiet).unwrap();
            assert_eq!(second.others.len(), 1);
            let kept = &second.others[0];
            assert_eq!(
                (kept.name, &kept.seeds, kept.program),
                ("kalman.vehicle", &vec![1, 2], program)
            );
            assert_eq!(kept.figures.len(), first.cases[0].figures.len());
            assert!(
                kept.passed() && kept.seconds.iter().all(Option::is_some) && !kept.plots.is_empty()
            );
        }
        assert_eq!(
            std::fs::read_to_string(directory.path().join(".gitignore")).unwrap(),
            "*\n"
        );
        let pages = tempfile::tempdir().unwrap();
        plan(&PLAIN, "a")
            .run(&Quiet)
            .unwrap()
            .write(pages.path())
            .unwrap();
        let page = std::fs::read_to_string(pages.path().join("figures.md")).unwrap();
        assert!(
            page.contains("`kalman.vehicle`") && page.contains("`test.plain`"),
            "{page}"
        );
        assert!(
            page.contains("No stored outcome of") && page.contains("`ekf.tower`"),
            "{page}"
        );
    }

    fn misses(run: &Run<'_>) -> Result<Outcome, ValidateError> {
        let known = Figure::new("known", run.seed as f64, Required::AtMost(1.0))
            .known_miss("the record is short");
        let holding =
            Figure::new("holding", 0.0, Required::AtMost(1.0)).known_miss("it used to miss");
        Ok(Outcome {
            figures: vec![known, holding],
            ..Outcome::default()
        })
    }

    static MISSED: Case = Case {
        name: "test.missed",
        title: "known misses",
        source: "here",
        weight: 1.0,
        run: misses,
    };

    #[test]
    fn known_miss_is_shown_with_its_reason_and_does_not_fail_the_run() {
        let report = Plan::new(vec![&MISSED], vec![101, 102], Length::Full)
            .run(&Quiet)
            .unwrap();
        assert!(
            report.passed()
                && !report.cases[0].figures[0].passed
                && !report.cases[0].figures[0].is_surprise()
        );
        let text = report.text();
        let line = "MISSED   known: 101, 102 (required ≤ 1); known: the record is short";
        assert!(text.contains(line), "{text}");
        assert!(
            text.contains("holds    holding: 0, 0 (required ≤ 1)\n"),
            "{text}"
        );
        assert!(
            text.contains("1 of 2 figures as required, 1 missed (1 of them known), 0 runs failed"),
            "{text}"
        );
        let pages = tempfile::tempdir().unwrap();
        report.write(pages.path()).unwrap();
        let page = std::fs::read_to_string(pages.path().join("figures.md")).unwrap();
        assert!(
            page.contains("| known | – | ≤ 1 | 101 | 102 | MISSED; known: the record is short |"),
            "{page}"
        );
        assert!(
            page.contains("`spandrel validate --seeds 101..102 --report DIRECTORY`"),
            "{page}"
        );
    }

    fn misses_by_more(run: &Run<'_>) -> Result<Outcome, ValidateError> {
        let figure = Figure::new("known", run.seed as f64, Required::AtMost(1.0))
            .known_miss_within(Required::AtMost(101.0), "the record is short");
        Ok(Outcome {
            figures: vec![figure],
            ..Outcome::default()
        })
    }

    #[test]
    fn a_known_miss_beyond_its_limits_fails_the_run() {
        let case = Box::leak(Box::new(Case {
            name: "test.missed-by-more",
            run: misses_by_more,
            ..MISSED
        }));
        for (seeds, passed) in [
            (vec![101], true),
            (vec![101, 102], false),
            (vec![102, 101], false),
        ] {
            let report = Plan::new(vec![&*case], seeds, Length::Full)
                .run(&Quiet)
                .unwrap();
            assert_eq!(report.passed(), passed, "{}", report.text());
        }
    }

    #[test]
    fn case_without_result_fails_and_the_others_continue() {
        let report = Plan::new(vec![&FAILED, &PLAIN], vec![1, 2, 3], Length::Full)
            .threads(2)
            .run(&Quiet)
            .unwrap();
        assert!(!report.passed());
        assert_eq!(report.cases[0].failures.len(), 3);
        assert_eq!(
            report.cases[1].figures[0].measured,
            [Some(1.0), Some(2.0), Some(3.0)]
        );
        assert!(
            !report.cases[1].figures[0].passed,
            "seed 3 misses what is required"
        );
    }
}
