use super::*;
use crate::testing::{closed, plan};

/// Opens the file and returns the epochs in it.
fn open(folder: &Path, plan: &JudgePlan) -> (EpochLog, Vec<ClosedEpoch>) {
    let mut found = Vec::new();
    let log = EpochLog::open(folder, plan, |epoch| found.push(epoch)).unwrap();
    (log, found)
}

/// Returns an epoch as the file gives it back.
fn kept(number: i64) -> ClosedEpoch {
    ClosedEpoch {
        deviations: Vec::new(),
        ..closed(number)
    }
}

fn written(numbers: std::ops::Range<i64>) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, found) = open(folder.path(), &plan());
    assert_eq!(found, []);
    numbers.for_each(|number| log.append(&closed(number)));
    folder
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

#[test]
fn epochs_return_with_the_same_bits() {
    let folder = written(0..200);
    let (mut log, found) = open(folder.path(), &plan());
    assert_eq!(found, (0..200).map(kept).collect::<Vec<_>>());
    // A later run continues the file.
    log.append(&ClosedEpoch {
        is_measured: false,
        ..closed(200)
    });
    let (_, found) = open(folder.path(), &plan());
    assert_eq!(found.len(), 201);
    assert!(!found[200].is_measured && found[199].is_measured);
    assert_eq!(names(folder.path()), [FILE]);
}

#[test]
fn the_file_may_end_anywhere_and_continues_after_its_last_complete_line() {
    let folder = written(0..2);
    let whole = std::fs::read(folder.path().join(FILE)).unwrap();
    for length in (0..=whole.len()).step_by(3) {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(FILE), &whole[..length]).unwrap();
        let (mut log, found) = open(folder.path(), &plan());
        let lines = whole[..length].iter().filter(|byte| **byte == b'\n');
        let complete = lines.count().saturating_sub(1);
        assert_eq!(found.len(), complete, "{length} bytes");
        log.append(&closed(9));
        let (_, found) = open(folder.path(), &plan());
        let mut expected: Vec<_> = (0..complete as i64).map(kept).collect();
        expected.push(kept(9));
        assert_eq!(found, expected, "{length} bytes");
        assert_eq!(names(folder.path()), [FILE], "{length} bytes");
    }
}

#[test]
fn a_damaged_or_missing_line_sets_the_file_aside_and_keeps_what_precedes_it() {
    let folder = written(0..5);
    let text = std::fs::read_to_string(folder.path().join(FILE)).unwrap();
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    let missing = [&lines[..3], &lines[4..]].concat().concat();
    let changed = text.replacen(lines[3], &lines[3].replacen('.', ".1", 1), 1);
    for damaged in [missing, changed] {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(FILE), &damaged).unwrap();
        let (_, found) = open(folder.path(), &plan());
        assert_eq!(found, (0..2).map(kept).collect::<Vec<_>>());
        assert_eq!(names(folder.path()), ["judge-epochs.1.csv", FILE]);
        let aside = folder.path().join("judge-epochs.1.csv");
        assert_eq!(std::fs::read_to_string(aside).unwrap(), damaged);
    }
}

#[test]
fn other_columns_begin_a_new_file() {
    let folder = written(0..5);
    let mut other = plan();
    other.condition_columns = vec!["air".to_owned()];
    let (_, found) = open(folder.path(), &other);
    assert_eq!(found, []);
    assert_eq!(names(folder.path()), ["judge-epochs.1.csv", FILE]);
    // The settings of the judgement are no columns.
    let folder = written(0..5);
    let mut other = plan();
    other.settings.loss = 0.05;
    assert_eq!(open(folder.path(), &other).1.len(), 5);
}

#[test]
fn epochs_wait_while_the_folder_is_gone() {
    let folder = written(0..3);
    let (mut log, _) = open(folder.path(), &plan());
    let away = folder.path().with_extension("away");
    std::fs::rename(folder.path(), &away).unwrap();
    log.append(&closed(3));
    log.append(&closed(4));
    assert_eq!(
        log.drops().collect::<Vec<_>>(),
        [("checkpoints-not-kept".to_owned(), 2)]
    );
    std::fs::rename(&away, folder.path()).unwrap();
    log.flush();
    let (_, found) = open(folder.path(), &plan());
    assert_eq!(found, (0..5).map(kept).collect::<Vec<_>>());
}

/// Regression: the file of a disk that is mounted again was cut to the length of the file that had
/// taken its place.
#[test]
fn the_file_that_returns_keeps_its_epochs() {
    let folder = written(0..5);
    let (mut log, _) = open(folder.path(), &plan());
    let away = folder.path().with_extension("away");
    std::fs::rename(folder.path(), &away).unwrap();
    std::fs::create_dir(folder.path()).unwrap();
    log.append(&closed(5));
    let meanwhile = open(folder.path(), &plan()).1;
    assert_eq!(meanwhile, [kept(5)]);
    std::fs::remove_dir_all(folder.path()).unwrap();
    std::fs::rename(&away, folder.path()).unwrap();
    log.append(&closed(6));
    log.append(&closed(7));
    let (_, found) = open(folder.path(), &plan());
    let expected = (0..8).filter(|number| *number != 5).map(kept);
    assert_eq!(found, expected.collect::<Vec<_>>());
    assert_eq!(names(folder.path()), [FILE]);
}

/// Regression: a line after a shortened file broke the chain of the check values, and the next
/// start set the file aside.
#[test]
fn a_shortened_file_continues_after_its_last_complete_line() {
    let folder = written(0..5);
    let (mut log, _) = open(folder.path(), &plan());
    let path = folder.path().join(FILE);
    let text = std::fs::read(&path).unwrap();
    std::fs::write(&path, &text[..text.len() - 3]).unwrap();
    log.append(&closed(5));
    let (_, found) = open(folder.path(), &plan());
    let expected = [0, 1, 2, 3, 5].map(kept);
    assert_eq!(found, expected);
    assert_eq!(names(folder.path()), [FILE]);
}

#[test]
fn a_part_of_a_line_of_an_earlier_attempt_is_replaced() {
    let folder = written(0..2);
    let (mut log, _) = open(folder.path(), &plan());
    let path = folder.path().join(FILE);
    let before = std::fs::read(&path).unwrap();
    log.append(&closed(2));
    let after = std::fs::read(&path).unwrap();
    let (mut log, _) = {
        std::fs::write(&path, &before).unwrap();
        open(folder.path(), &plan())
    };
    std::fs::write(&path, &after[..after.len() - 5]).unwrap();
    log.append(&closed(2));
    assert_eq!(std::fs::read(&path).unwrap(), after);
}
