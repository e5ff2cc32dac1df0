//! The annotations of a series that is judged offline.

use crate::error::AppError;
use jiff::Timestamp;
use spandrel_bus::{Annotation, read_text_up_to};
use spandrel_judge::{Judge, NewReference};
use spandrel_judging::{NotedLine, new_reference, read_annotations};
use spandrel_record::RecordError;
use spandrel_structure::JudgedStructure;
use std::path::{Path, PathBuf};
use tracing::warn;

/// Maximum size of a file of annotations (bytes): some 100,000 annotations.
const MOST_ANNOTATION_BYTES: u64 = 64 << 20;

/// A new reference, and the line of the file that starts it.
pub(super) struct NotedReference {
    path: PathBuf,
    line: usize,
    new: NewReference,
}

/// Reads a file of annotations, and schedules its new references.
///
/// A note about another structure, or about a quantity that is not judged, is left out with a
/// warning, because a file can contain the notes of several structures.
///
/// # Errors
/// The file cannot be read.
pub(super) fn read(
    path: &Path,
    structure: &JudgedStructure,
    judge: &mut Judge,
) -> Result<Vec<NotedReference>, AppError> {
    let read = read_text_up_to(path, MOST_ANNOTATION_BYTES);
    let text = read.map_err(|source| RecordError::Open {
        path: path.to_owned(),
        source,
    })?;
    let mut references = Vec::new();
    for NotedLine { line, annotation } in read_annotations(&text, path) {
        if let Some(reason) = other_subject(&annotation, structure) {
            warn!(file = %path.display(), line, %reason, "note left out");
            continue;
        }
        if let Some(new) = new_reference(&annotation, judge.settings()) {
            judge.start_anew(new);
            references.push(NotedReference {
                path: path.to_owned(),
                line,
                new,
            });
        }
    }
    Ok(references)
}

/// Returns what an annotation is about, if that is not judged here, and what it could be about.
fn other_subject(annotation: &Annotation, structure: &JudgedStructure) -> Option<String> {
    let judged = structure.name.as_str();
    if annotation.structure.as_str() != judged {
        let found = annotation.structure.as_str();
        return Some(format!("structure is `{found}`, must be `{judged}`"));
    }
    let found = annotation.quantity.as_ref()?.as_str();
    let quantities = structure.plan.settings.quantities.iter();
    let names: Vec<&str> = quantities.map(|quantity| quantity.name.as_str()).collect();
    let allowed = names.join("`, `");
    (!names.contains(&found)).then(|| format!("quantity is `{found}`, must be one of: `{allowed}`"))
}

/// Warns of new references that do not begin within the series. `span_s` contains its first and
/// last time (s since 1970-01-01 UTC).
pub(super) fn warn_outside(references: &[NotedReference], span_s: [f64; 2]) {
    let [first_s, last_s] = span_s;
    for NotedReference { path, line, new } in references {
        if (first_s..=last_s).contains(&new.time_s) {
            continue;
        }
        warn!(
            file = %path.display(),
            line,
            begins = %utc(new.time_s),
            earliest = %utc(first_s),
            latest = %utc(last_s),
            "new reference has no effect, because it begins outside the series (`from_ns` is in \
             nanoseconds since 1970)"
        );
    }
}

/// Returns a time (s since 1970-01-01 UTC) in ISO 8601, at a second.
fn utc(time_s: f64) -> String {
    let timestamp = Timestamp::from_second(time_s as i64);
    timestamp.map_or_else(|_| format!("{time_s} s"), |time| time.to_string())
}
