//! Reports the recordings of one structure in the order of time.

use crate::maker::{MadeReport, ReportCourse, ReportMaker};
use crate::name::{date, duration};
use crate::records::{Kept, Records};
use spandrel_earthquake::{CutKind, Ending};
use std::collections::BTreeMap;
use std::sync::Arc;

/// What the work on one recording has led to.
#[derive(Debug)]
pub(crate) enum Work {
    /// A report is new.
    Reported(Kept, MadeReport),
    /// The report existed, and the history of the events has been computed again.
    Known,
    /// The recording is not reported, for this reason.
    Failed(Kept, String),
    /// Nothing is left to do.
    Nothing,
}

/// The place where reports are made. Its work takes seconds, so it belongs on a thread of its own.
#[derive(Debug)]
pub(crate) struct Desk {
    records: Records,
    maker: Arc<dyn ReportMaker>,
    /// Number of recordings that are kept.
    keep: usize,
    course: Option<Box<dyn ReportCourse>>,
    /// The recordings that the history contains, with their starts (ns), in the order of time.
    taken: Vec<(i64, String)>,
    /// Why recordings are not reported.
    failed: BTreeMap<String, String>,
}

impl Desk {
    pub(crate) fn new(records: Records, maker: Arc<dyn ReportMaker>, keep: usize) -> Self {
        Self {
            records,
            maker,
            keep,
            course: None,
            taken: Vec::new(),
            failed: BTreeMap::new(),
        }
    }

    /// Works on the next recording that the history lacks. `standing` are the open alerts, in
    /// words.
    pub(crate) fn work(&mut self, standing: &[String]) -> Work {
        match self.records.trim(self.keep) {
            Ok(true) => self.course = None,
            Ok(false) => {}
            Err(error) => tracing::warn!(%error, "cannot remove old recordings of earthquakes"),
        }
        let Ok(all) = self.records.list() else {
            return Work::Nothing; // the folder is gone, and may come back
        };
        let is_taken =
            |kept: &Kept, taken: &[(i64, String)]| taken.iter().any(|(_, stem)| *stem == kept.stem);
        let is_open = |kept: &&Kept, taken: &[(i64, String)]| {
            !is_taken(kept, taken) && !self.failed.contains_key(&kept.stem)
        };
        // The clock may have gone back. The history has an order, so it begins anew.
        let next = all.iter().find(|kept| is_open(kept, &self.taken));
        let is_before = |kept: &Kept| {
            let last = self.taken.last();
            last.is_some_and(|(start_ns, _)| kept.about.start_ns < *start_ns)
        };
        if self.course.is_none() || next.is_some_and(is_before) {
            self.taken.clear();
            self.course = None;
        }
        let next = all.iter().find(|kept| is_open(kept, &self.taken));
        let Some(kept) = next.cloned() else {
            return Work::Nothing;
        };
        match self.report(&kept, standing) {
            Ok(Some(made)) => Work::Reported(kept, made),
            Ok(None) => Work::Known,
            Err(trouble) => {
                // The history may lack this event or contain it.
                self.course = None;
                let why = match trouble {
                    Trouble::Recording(why) => {
                        self.failed.insert(kept.stem.clone(), why.clone());
                        why
                    }
                    Trouble::Disk(why) => why,
                };
                Work::Failed(kept, why)
            }
        }
    }

    fn report(&mut self, kept: &Kept, standing: &[String]) -> Result<Option<MadeReport>, Trouble> {
        let course = match &mut self.course {
            Some(course) => course,
            none => none.insert(self.maker.begin().map_err(Trouble::Recording)?),
        };
        let record = self.records.record(&kept.stem);
        let made = course.report(&record, &occasion(kept), standing);
        let made = made.map_err(Trouble::Recording)?;
        let start_ns = kept.about.start_ns;
        self.taken.push((start_ns, kept.stem.clone()));
        if self.records.is_reported(&kept.stem) {
            return Ok(None);
        }
        let put = self.records.put(&kept.stem, &made);
        put.map_err(|error| Trouble::Disk(error.to_string()))?;
        Ok(Some(made))
    }
}

/// Why a report is not made.
enum Trouble {
    /// The recording cannot be reported. Another attempt would not help.
    Recording(String),
    /// The report cannot be written. The next attempt may succeed.
    Disk(String),
}

/// Returns why a recording was made, in words. Empty for a complete earthquake.
pub(crate) fn occasion(kept: &Kept) -> String {
    match &kept.about.kind {
        CutKind::Earthquake { ending, .. } => match ending {
            Ending::Calm => String::new(),
            Ending::Longest => {
                "The motion continues. The recording has its maximum length.".to_owned()
            }
            Ending::Interrupted => {
                "The recording is incomplete, because no more samples arrived.".to_owned()
            }
        },
        CutKind::Later { due } => {
            let each = due.iter().map(|due| {
                format!(
                    "{} after the earthquake of {}",
                    duration(due.after_s),
                    date(due.of_ns)
                )
            });
            let each: Vec<String> = each.collect();
            format!("Weak motion {}.", each.join(", and "))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cutting::{About, Recorded};
    use crate::maker::ReportIndex;
    use spandrel_bus::Name;
    use std::path::Path;
    use std::sync::Mutex;

    /// A maker whose report states the recordings so far. It rejects a recording that starts with a
    /// 7.
    #[derive(Debug, Default)]
    struct Counting(Arc<Mutex<Vec<String>>>);

    #[derive(Debug)]
    struct Counted(Arc<Mutex<Vec<String>>>, Vec<String>);

    impl ReportMaker for Counting {
        fn begin(&self) -> Result<Box<dyn ReportCourse>, String> {
            Ok(Box::new(Counted(self.0.clone(), Vec::new())))
        }

        fn index(&self, _: &Path, waiting: &[String]) -> Result<ReportIndex, String> {
            let html = waiting.join(" ");
            let json = html.clone();
            Ok(ReportIndex { html, json })
        }
    }

    impl ReportCourse for Counted {
        fn report(&mut self, record: &Path, _: &str, _: &[String]) -> Result<MadeReport, String> {
            let stem = record.file_stem().unwrap().to_string_lossy().into_owned();
            if std::fs::read_to_string(record).unwrap().contains("\n7") {
                return Err("seven".to_owned());
            }
            self.1.push(stem.clone());
            self.0.lock().unwrap().push(stem);
            Ok(MadeReport {
                html: String::new(),
                json: self.1.join(","),
                urgency: "watch".to_owned(),
                headline: "it shook".to_owned(),
            })
        }
    }

    fn recorded(start_s: i64) -> Recorded {
        let start_ns = start_s * 1_000_000_000;
        Recorded {
            about: About {
                start_ns,
                end_ns: start_ns,
                kind: CutKind::Later { due: Vec::new() },
            },
            rows: vec![(start_ns, vec![1.0])],
        }
    }

    fn desk(folder: &Path) -> (Records, Desk, Arc<Mutex<Vec<String>>>) {
        let structure = Name::new("tower").unwrap();
        let records = Records::open(folder, &structure, vec!["roof".to_owned()]).unwrap();
        let maker = Counting::default();
        let made = maker.0.clone();
        let desk = Desk::new(records.clone(), Arc::new(maker), 100);
        (records, desk, made)
    }

    /// Works until nothing is left, and returns the number of new reports and of failures.
    fn all(desk: &mut Desk) -> (usize, usize) {
        let (mut reported, mut failed) = (0, 0);
        loop {
            match desk.work(&[]) {
                Work::Reported(..) => reported += 1,
                Work::Known => {}
                Work::Failed(..) => failed += 1,
                Work::Nothing => return (reported, failed),
            }
        }
    }

    #[test]
    fn after_a_restart_only_what_was_due_is_reported_in_the_order_of_all_events() {
        let folder = tempfile::tempdir().unwrap();
        let (records, mut first, _) = desk(folder.path());
        records.keep(&recorded(1000)).unwrap();
        assert_eq!(all(&mut first), (1, 0));
        records.keep(&recorded(2000)).unwrap();
        let (_, mut second, made) = desk(folder.path());
        assert_eq!(all(&mut second), (1, 0));
        assert_eq!(made.lock().unwrap().len(), 2);
        let last = records.list().unwrap().pop().unwrap();
        let name = crate::name::report_name(&last.stem).unwrap();
        let (_, json) = records.page(&name).unwrap();
        assert_eq!(json, "1970-01-01T00-16-40Z,1970-01-01T00-33-20Z");
    }

    #[test]
    fn an_earlier_recording_begins_the_course_anew_and_a_failed_one_is_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let (records, mut desk, made) = desk(folder.path());
        records.keep(&recorded(2000)).unwrap();
        all(&mut desk);
        records.keep(&recorded(1000)).unwrap();
        records.keep(&recorded(7000)).unwrap();
        assert_eq!(all(&mut desk), (1, 1));
        let made = made.lock().unwrap();
        let before = [
            "1970-01-01T00-33-20Z",
            "1970-01-01T00-16-40Z",
            "1970-01-01T00-33-20Z",
        ];
        assert_eq!(made[..3], before);
        assert_eq!(desk.failed.values().collect::<Vec<_>>(), ["seven"]);
    }
}
