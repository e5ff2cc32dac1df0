//! The state that judges: epochs, annotations and configurations are kept before they count.

use crate::annotations::{AnnotationLog, Refusal};
use crate::configurations::{Begun, Configuration, ConfigurationLog, Place};
use crate::epoch_log::EpochLog;
use crate::epochs::ClosedEpoch;
use crate::error::JudgingError;
use crate::judging::{Judging, differences, new_reference};
use crate::loss_log::LossLog;
use crate::past::judge_past;
use spandrel_bus::{Annotation, Event, JudgementDisplay, JudgementLog};
use spandrel_service::Clock;
use spandrel_structure::JudgePlan;
use std::collections::BTreeMap;
use std::path::PathBuf;
use tracing::warn;

/// The state that judges epochs. It runs on a separate thread, because learning a reference would
/// block an async thread for too long.
#[derive(Debug)]
pub(crate) struct Bench {
    pub(crate) judging: Judging,
    /// The judge before any epoch and annotation.
    blank: Judging,
    log: Option<EpochLog>,
    annotations: AnnotationLog,
    configurations: Option<ConfigurationLog>,
    losses: LossLog,
    clock: Clock,
    /// Where epochs and annotations are kept.
    saved: Option<Saved>,
    /// Events about the saved epochs that are not published yet.
    told: Vec<Event>,
}

/// Where the epochs of a judgement are kept.
#[derive(Debug, Clone)]
pub(crate) struct Saved {
    pub(crate) folder: PathBuf,
    pub(crate) plan: JudgePlan,
}

/// What a number of epochs has changed.
#[derive(Debug, Default)]
pub(crate) struct Outcome {
    pub(crate) events: Vec<Event>,
    pub(crate) is_day_over: bool,
    pub(crate) refused: u64,
    /// The epochs that were not refused.
    pub(crate) taken: Vec<ClosedEpoch>,
}

impl Bench {
    /// Judges the epochs of the file in a folder, if there is a folder.
    pub(crate) fn open(
        blank: Judging,
        saved: Option<Saved>,
        clock: Clock,
    ) -> Result<Self, JudgingError> {
        let (annotations, configurations) = match &saved {
            Some(Saved { folder, .. }) => (
                AnnotationLog::open(folder)?,
                Some(ConfigurationLog::open(folder)?),
            ),
            None => (AnnotationLog::default(), None),
        };
        let folder = saved.as_ref().map(|saved| saved.folder.as_path());
        let losses = LossLog::open(blank.structure(), folder);
        let mut bench = Self {
            judging: blank.clone(),
            blank,
            log: None,
            annotations,
            configurations,
            losses,
            clock,
            saved,
            told: Vec::new(),
        };
        let former = bench.former();
        bench.judge_again()?;
        if let Some(former) = former {
            let now_ns = bench.clock.now_ns();
            let displays = bench.judging.displays(now_ns);
            bench.told.extend(differences(&former, &displays, now_ns));
        }
        bench.note_losses();
        Ok(bench)
    }

    /// Returns the states under the last configuration, if another one is in force now. They are
    /// those of this version of the program. `None` as well if they cannot be repeated.
    fn former(&self) -> Option<Vec<JudgementDisplay>> {
        let saved = self.saved.as_ref()?;
        let last = self.configurations.as_ref()?.last_name()?;
        let present = configuration(saved, &self.annotations).name().ok()?;
        if present == last {
            return None;
        }
        let structure = self.judging.structure();
        let past = judge_past(&saved.folder, structure, i64::MAX, Some(last));
        past.ok().map(|past| past.displays)
    }

    /// Keeps the changes of lasting losses that the present states reveal.
    fn note_losses(&mut self) {
        let displays = self.judging.displays(self.clock.now_ns());
        self.losses.note(&displays);
    }

    /// Returns the last changes of the lasting losses.
    pub(crate) fn losses(&self) -> &JudgementLog {
        self.losses.log()
    }

    /// Returns the events about the saved epochs that are not published yet.
    pub(crate) fn take_told(&mut self) -> Vec<Event> {
        std::mem::take(&mut self.told)
    }

    /// Judges the epochs of the file with all annotations.
    fn judge_again(&mut self) -> Result<(), JudgingError> {
        let mut judging = self.blank.clone();
        let known = self.annotations.all().iter();
        known.for_each(|annotation| judging.annotate(annotation.clone()));
        if let Some(Saved { folder, plan }) = &self.saved {
            let mut refused = 0_u64;
            let log = EpochLog::open(folder, plan, |closed| {
                // The events were published when the epoch was new.
                refused += u64::from(judging.handle(&closed, &mut Vec::new()).is_err());
            })?;
            if refused > 0 {
                warn!(epochs = refused, "saved epochs rejected");
            }
            self.log = Some(log);
        }
        self.judging = judging;
        self.begin_configuration();
        Ok(())
    }

    /// Records the configuration in force, if it or its file of epochs has changed.
    fn begin_configuration(&mut self) {
        let Some((saved, log)) = self.saved.as_ref().zip(self.log.as_mut()) else {
            return;
        };
        let begun = Begun {
            time_ns: self.clock.now_ns(),
            since: log.place(),
            is_complete: log.incomplete().is_none(),
            aside: log.take_aside(),
            configuration: configuration(saved, &self.annotations),
        };
        match self.configurations.as_mut().map(|log| log.begin(begun)) {
            Some(Ok(name)) => self.judging.set_configuration(name),
            Some(Err(error)) => warn!(%error, "the configuration is not recorded"),
            None => {}
        }
    }

    fn incomplete(&self) -> Option<Place> {
        self.log.as_ref().and_then(EpochLog::incomplete)
    }

    /// Keeps an annotation. If it starts a reference in the past, the epochs since then are judged
    /// again, as after a restart.
    pub(crate) fn annotate(&mut self, annotation: Annotation) -> Result<(), Refusal> {
        if !self.judging.knows(&annotation) {
            return Err(Refusal::Unknown);
        }
        let is_again = self.saved.is_some() && self.judging.is_past(&annotation);
        if is_again && self.log.as_ref().is_some_and(EpochLog::is_behind) {
            return Err(Refusal::Behind);
        }
        self.annotations.append(&annotation)?;
        match is_again {
            true => self.judge_again()?,
            false => {
                self.judging.annotate(annotation);
                self.begin_configuration();
            }
        }
        self.note_losses();
        Ok(())
    }

    /// Saves each epoch before it is judged, so that a restart judges it as well.
    pub(crate) fn judge(&mut self, closed: &[ClosedEpoch]) -> Outcome {
        let mut outcome = Outcome::default();
        let incomplete = self.incomplete();
        if closed.is_empty() {
            self.log.iter_mut().for_each(EpochLog::flush);
            let configurations = self.configurations.iter_mut();
            configurations.for_each(ConfigurationLog::flush);
            self.losses.flush();
        }
        for closed in closed {
            if let Some(log) = &mut self.log {
                log.append(closed);
            }
            match self.judging.handle(closed, &mut outcome.events) {
                Ok(is_day_over) => {
                    outcome.is_day_over |= is_day_over;
                    if is_day_over {
                        self.note_losses();
                    }
                    outcome.taken.push(closed.clone());
                }
                Err(error) => {
                    outcome.refused += 1;
                    warn!(%error, "epoch rejected");
                }
            }
        }
        if self.incomplete() != incomplete {
            self.begin_configuration();
        }
        outcome
    }

    /// Returns the counts of failed writes and of lost epochs.
    pub(crate) fn drops(&self) -> BTreeMap<String, u64> {
        let mut drops: BTreeMap<_, _> = self.log.iter().flat_map(EpochLog::drops).collect();
        let configurations = self.configurations.iter();
        let others = configurations.filter_map(ConfigurationLog::drops);
        for (name, count) in others.chain(self.losses.drops()) {
            *drops.entry(name).or_default() += count;
        }
        drops
    }
}

/// Returns the configuration in force.
fn configuration(saved: &Saved, annotations: &AnnotationLog) -> Configuration {
    let settings = &saved.plan.settings;
    let all = annotations.all().iter();
    let references = all.filter(|annotation| new_reference(annotation, settings).is_some());
    Configuration {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        judge: saved.plan.clone(),
        references: references.cloned().collect(),
    }
}
