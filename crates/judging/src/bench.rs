//! The state that judges: epochs and annotations are kept, then judged.

use crate::annotations::{AnnotationLog, Refusal};
use crate::epoch_log::EpochLog;
use crate::epochs::ClosedEpoch;
use crate::error::JudgingError;
use crate::judging::Judging;
use spandrel_bus::{Annotation, Event};
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
    /// Where epochs and annotations are kept.
    saved: Option<Saved>,
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
}

impl Bench {
    /// Judges the epochs of the file in a folder, if there is a folder.
    pub(crate) fn open(blank: Judging, saved: Option<Saved>) -> Result<Self, JudgingError> {
        let annotations = match &saved {
            Some(saved) => AnnotationLog::open(&saved.folder)?,
            None => AnnotationLog::default(),
        };
        let mut bench = Self {
            judging: blank.clone(),
            blank,
            log: None,
            annotations,
            saved,
        };
        bench.judge_again()?;
        Ok(bench)
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
        Ok(())
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
            false => self.judging.annotate(annotation),
        }
        Ok(())
    }

    /// Saves each epoch before it is judged, so that a restart judges it as well.
    pub(crate) fn judge(&mut self, closed: &[ClosedEpoch]) -> Outcome {
        let mut outcome = Outcome::default();
        if closed.is_empty() {
            self.log.iter_mut().for_each(EpochLog::flush);
        }
        for closed in closed {
            if let Some(log) = &mut self.log {
                log.append(closed);
            }
            match self.judging.handle(closed, &mut outcome.events) {
                Ok(is_day_over) => outcome.is_day_over |= is_day_over,
                Err(error) => {
                    outcome.refused += 1;
                    warn!(%error, "epoch rejected");
                }
            }
        }
        outcome
    }

    /// Returns the counts of failed writes and of lost epochs.
    pub(crate) fn drops(&self) -> BTreeMap<String, u64> {
        self.log.iter().flat_map(EpochLog::drops).collect()
    }
}
