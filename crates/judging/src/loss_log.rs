//! The file of the changes of the lasting losses of one structure, as they were stated.
//!
//! A new reference in the past judges the past again, and so does another configuration. What was
//! stated before can therefore not be repeated from the epochs.

use spandrel_bus::{
    JudgementDisplay, JudgementLog, LossChange, Message as _, Name, read_text_up_to,
};
use spandrel_checkpoint::{Failures, replace_private_file};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use tracing::{info, warn};

/// Name of the file, in the folder of the epochs.
pub(crate) const FILE: &str = "judge-losses.json";
/// Maximum size of the file (bytes), above that of a log whose texts all have their longest form.
const MOST_BYTES: u64 = 8 << 20;

/// The last changes of the lasting losses, which are kept in a file.
#[derive(Debug)]
pub(crate) struct LossLog {
    /// `None` if nothing is kept.
    path: Option<PathBuf>,
    log: JudgementLog,
    is_saved: bool,
    failures: Failures,
}

impl LossLog {
    /// Reads the file in a folder, if there is one. A file that cannot be used is replaced at the
    /// next change.
    pub(crate) fn open(structure: &Name, folder: Option<&Path>) -> Self {
        let path = folder.map(|folder| folder.join(FILE));
        let read = path.as_deref().and_then(|path| {
            let log = read(path, structure);
            log.unwrap_or_else(|error| {
                warn!(file = %path.display(), %error, "the past of the lasting losses is lost");
                None
            })
        });
        let empty = || JudgementLog {
            structure: structure.clone(),
            changes: Vec::new(),
        };
        Self {
            path,
            log: read.unwrap_or_else(empty),
            is_saved: true,
            failures: Failures::default(),
        }
    }

    pub(crate) fn log(&self) -> &JudgementLog {
        &self.log
    }

    /// Keeps the changes that the present judgements of all quantities reveal. If they cannot be
    /// written, they wait.
    pub(crate) fn note(&mut self, displays: &[JudgementDisplay]) {
        for display in displays {
            self.is_saved &= !LossChange::note(&mut self.log.changes, display);
        }
        self.is_saved &= !LossChange::end_unjudged(&mut self.log.changes, displays);
        self.flush();
    }

    /// Tries to write what waits. The call blocks the thread during the write.
    pub(crate) fn flush(&mut self) {
        let Some(path) = self.path.as_deref().filter(|_| !self.is_saved) else {
            return;
        };
        let bytes = self.log.encode().map_err(io::Error::other);
        match bytes.and_then(|bytes| replace_private_file(path, &bytes)) {
            Ok(()) => {
                self.is_saved = true;
                if let Some(failures) = self.failures.succeeded() {
                    info!(failures, "changes of lasting losses are saved again");
                }
            }
            Err(error) if self.failures.failed() => {
                let (file, failures) = (path.display(), self.failures.consecutive());
                warn!(%file, %error, failures, "cannot save the changes of lasting losses");
            }
            Err(_) => {}
        }
    }

    /// Returns the count of failed writes.
    pub(crate) fn drops(&self) -> Option<(String, u64)> {
        self.failures.drops()
    }
}

/// Returns the log of a structure in a file, or `None` if there is no file.
fn read(path: &Path, structure: &Name) -> io::Result<Option<JudgementLog>> {
    let text = match read_text_up_to(path, MOST_BYTES) {
        Ok(text) => text,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    let log =
        JudgementLog::decode("application/json", text.as_bytes()).map_err(io::Error::other)?;
    if log.structure != *structure {
        return Err(io::Error::other(format!("is about {}", log.structure)));
    }
    Ok(Some(log))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::{Bench, Saved};
    use crate::judging::Judging;
    use crate::testing::{S, name, of_day, plan};
    use spandrel_bus::{AlertState, Annotation, AnnotationEffect, AnnotationKind};
    use spandrel_service::Clock;

    const NOW_NS: i64 = 1_700_000_000 * S;

    fn bench(folder: &Path) -> Bench {
        let saved = Saved {
            folder: folder.to_owned(),
            plan: plan(),
        };
        let blank = Judging::of_plan(name("bridge"), &plan()).unwrap();
        Bench::open(blank, Some(saved), Clock::fixed(NOW_NS)).unwrap()
    }

    /// With this reference, the loss is never found.
    #[test]
    fn what_was_stated_remains_after_a_reference_from_before_it_and_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let mut service = bench(folder.path());
        for number in 0..270 {
            let stiffness = if number < 180 { 1.0 } else { 0.95 };
            service.judge(&[of_day(number / 3, number % 3, stiffness)]);
        }
        let states = |bench: &Bench| -> Vec<AlertState> {
            let changes = bench.losses().changes.iter();
            changes.map(|change| change.state).collect()
        };
        assert_eq!(states(&service), [AlertState::Raised]);
        let annotated = service.annotate(Annotation {
            structure: name("bridge"),
            quantity: None,
            time_ns: NOW_NS,
            from_ns: 61 * 86_400 * S,
            to_ns: None,
            kind: AnnotationKind::Repair,
            effect: AnnotationEffect::NewReference,
            who: "ada".to_owned(),
            text: "new bearings".to_owned(),
        });
        annotated.unwrap();
        assert_eq!(states(&service), [AlertState::Raised, AlertState::Cleared]);
        let log = service.losses().clone();
        assert_eq!(log.changes[1].time_ns, NOW_NS);
        assert_eq!(bench(folder.path()).losses(), &log);
        std::fs::write(folder.path().join(FILE), "{").unwrap();
        assert_eq!(states(&bench(folder.path())), []);
    }
}
