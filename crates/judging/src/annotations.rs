//! The file of the annotations of one structure: one JSON message per line.

use crate::error::JudgingError;
use spandrel_bus::{Annotation, JudgementCourse, Message as _};
use spandrel_checkpoint::sync_name;
use std::fs::OpenOptions;
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use tracing::warn;

/// Name of the file, in the folder of the epochs.
pub(crate) const FILE: &str = "judge-annotations.jsonl";

/// The annotations of one structure, which are kept in a file.
#[derive(Debug, Default)]
pub(crate) struct AnnotationLog {
    /// `None` if nothing is kept.
    path: Option<PathBuf>,
    all: Vec<Annotation>,
}

/// An annotation of a file, and its line (from 1).
#[derive(Debug, Clone, PartialEq)]
pub struct NotedLine {
    /// Line of the annotation.
    pub line: usize,
    /// The annotation.
    pub annotation: Annotation,
}

/// Why an annotation is not kept.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Refusal {
    #[error("it is about another structure or a quantity that is not judged")]
    Unknown,
    #[error("the structure has {} annotations", JudgementCourse::MOST_ANNOTATIONS)]
    Full,
    #[error("the epochs are not saved, so the past cannot be judged again")]
    Behind,
    #[error("the file cannot be written: {0}")]
    File(std::io::Error),
    #[error("the past cannot be judged again: {0}")]
    Again(JudgingError),
}

// Not sources, because the text contains them.
impl From<std::io::Error> for Refusal {
    fn from(error: std::io::Error) -> Self {
        Self::File(error)
    }
}

impl From<JudgingError> for Refusal {
    fn from(error: JudgingError) -> Self {
        Self::Again(error)
    }
}

impl AnnotationLog {
    /// Reads the file in a folder, if it exists.
    ///
    /// # Errors
    /// The file cannot be read.
    pub(crate) fn open(folder: &Path) -> Result<Self, JudgingError> {
        let path = folder.join(FILE);
        let all = match std::fs::read_to_string(&path) {
            Ok(text) => {
                let lines = read(&text, &path).into_iter();
                lines.map(|noted| noted.annotation).collect()
            }
            Err(error) if error.kind() == ErrorKind::NotFound => Vec::new(),
            Err(source) => {
                return Err(JudgingError::Annotations { path, source });
            }
        };
        Ok(Self {
            path: Some(path),
            all,
        })
    }

    pub(crate) fn all(&self) -> &[Annotation] {
        &self.all
    }

    /// Keeps an annotation. On return it is on disk, if there is a file.
    ///
    /// # Errors
    /// There are too many, or the file cannot be written.
    pub(crate) fn append(&mut self, annotation: &Annotation) -> Result<(), Refusal> {
        if self.all.len() >= JudgementCourse::MOST_ANNOTATIONS {
            return Err(Refusal::Full);
        }
        if let Some(path) = &self.path {
            // A line begins with a line break, so that it does not continue a torn one.
            let mut line = b"\n".to_vec();
            line.extend(annotation.encode().map_err(std::io::Error::other)?);
            let mut file = OpenOptions::new().append(true).create(true).open(path)?;
            let is_new = file.metadata()?.len() == 0;
            file.write_all(&line)?;
            file.sync_data()?;
            if is_new {
                sync_name(path);
            }
        }
        self.all.push(annotation.clone());
        Ok(())
    }
}

/// Parses annotations, one JSON message per line, as the service `judge` writes them.
///
/// Returns at most [`JudgementCourse::MOST_ANNOTATIONS`] annotations, the first ones of the text.
///
/// Lines that are not annotations are skipped with a warning that names `path`, because a crash can
/// truncate the last line.
#[must_use]
pub fn read(text: &str, path: &Path) -> Vec<NotedLine> {
    let lines = text.lines().enumerate();
    let lines = lines.filter(|(_, line)| !line.trim().is_empty());
    let read = |(number, line): (usize, &str)| {
        let annotation = Annotation::decode("application/json", line.as_bytes());
        let annotation = annotation
            .inspect_err(|error| {
                warn!(file = %path.display(), line = number + 1, %error, "not an annotation; left \
                                                                          out");
            })
            .ok()?;
        Some(NotedLine {
            line: number + 1,
            annotation,
        })
    };
    let all = lines.filter_map(read);
    all.take(JudgementCourse::MOST_ANNOTATIONS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{S, name};
    use spandrel_bus::{AnnotationEffect, AnnotationKind};

    fn annotation(second: i64) -> Annotation {
        Annotation {
            structure: name("bridge"),
            quantity: None,
            time_ns: second * S,
            from_ns: second * S,
            to_ns: None,
            kind: AnnotationKind::Inspection,
            effect: AnnotationEffect::Seen,
            who: "ada".to_owned(),
            text: "two\nlines".to_owned(),
        }
    }

    #[test]
    fn annotations_are_read_back_also_after_a_torn_line() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = AnnotationLog::open(folder.path()).unwrap();
        log.append(&annotation(1)).unwrap();
        log.append(&annotation(2)).unwrap();
        let path = folder.path().join(FILE);
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, &text[..text.len() - 3]).unwrap();
        let mut log = AnnotationLog::open(folder.path()).unwrap();
        assert_eq!(log.all(), [annotation(1)]);
        log.append(&annotation(3)).unwrap();
        let log = AnnotationLog::open(folder.path()).unwrap();
        assert_eq!(log.all(), [annotation(1), annotation(3)]);
    }

    #[test]
    fn the_number_of_annotations_is_limited() {
        let mut log = AnnotationLog::default();
        for second in 0..JudgementCourse::MOST_ANNOTATIONS as i64 {
            log.append(&annotation(second)).unwrap();
        }
        assert!(matches!(log.append(&annotation(9)), Err(Refusal::Full)));
    }
}
