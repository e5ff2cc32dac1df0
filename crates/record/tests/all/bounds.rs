//! Files that are huge, or expand to something huge, are refused before they need memory.

use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use spandrel_record::{
    ColumnMapping, CsvReader, OffsetRemoval, ReadOptions, RecordError, RecordReader, RecordedFile,
    Recording, TimeSource,
};
use tempfile::TempDir;

/// Memory that a refused file may need at most (bytes).
const MOST_BYTES: u64 = 200 << 20;

const MIB: usize = 1 << 20;

/// A file in a folder of its own.
struct Given {
    _folder: TempDir,
    path: PathBuf,
}

fn given(name: &str, write: impl FnOnce(&mut File)) -> Given {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    write(&mut File::create(&path).unwrap());
    Given {
        _folder: folder,
        path,
    }
}

/// Returns gzip data of `piece` repeated `count` times, after `head`.
fn gzip(head: &[u8], piece: &[u8], count: usize) -> Vec<u8> {
    let member = |content: &[u8]| {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
        encoder.write_all(content).unwrap();
        encoder.finish().unwrap()
    };
    let mut bytes = member(head);
    bytes.extend(member(piece).repeat(count));
    bytes
}

/// Returns a zip archive of one file: `piece` repeated `count` times, after `head`.
fn zip(head: &[u8], piece: &[u8], count: usize) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    archive
        .start_file("bomb", zip::write::SimpleFileOptions::default())
        .unwrap();
    archive.write_all(head).unwrap();
    (0..count).for_each(|_| archive.write_all(piece).unwrap());
    archive.finish().unwrap().into_inner()
}

/// Reads a file as a whole, as `info` and `convert` do, and row by row, as `estimate` does. Returns
/// both errors.
fn refusals(path: &Path) -> [String; 2] {
    let rows = || -> Result<(), RecordError> {
        let mapping =
            ColumnMapping::by_name(["1"]).with_time(TimeSource::Counted { rate_hz: 100.0 });
        let mut recording = Recording::open(path, &mapping, OffsetRemoval::Keep)?;
        while recording.next_row()?.is_some() {}
        Ok(())
    };
    let whole = || RecordedFile::read(path, &ReadOptions::default()).map(|_| ());
    [bounded(whole), bounded(rows)]
}

/// Returns the error of an attempt, which must need little memory.
#[track_caller]
fn bounded(attempt: impl FnOnce() -> Result<(), RecordError>) -> String {
    let mut told = String::new();
    let used = allocation_counter::measure(|| {
        let error = attempt().unwrap_err();
        told = error.to_string();
        let mut cause = std::error::Error::source(&error);
        while let Some(error) = cause {
            told += &format!(": {error}");
            cause = error.source();
        }
    });
    assert!(
        used.bytes_max < MOST_BYTES,
        "{} MB for: {told}",
        used.bytes_max >> 20
    );
    told
}

#[track_caller]
fn assert_told(path: &Path, parts: &[&str]) {
    for told in refusals(path) {
        let missing = parts.iter().find(|part| !told.contains(**part));
        assert_eq!(missing, None, "{told}");
    }
}

#[test]
fn gigabyte_of_zeros_in_gzip_is_of_unknown_format() {
    let bomb = gzip(&[], &vec![0; 16 * MIB], 64);
    let file = given("bomb.csv.gz", |file| file.write_all(&bomb).unwrap());
    assert_told(&file.path, &["bomb.csv", "unknown format"]);
}

#[test]
fn gigabyte_of_equal_rows_in_gzip_exceeds_the_ratio() {
    let bomb = gzip(b"", "0.5,1.5\n".repeat(2 * MIB).as_bytes(), 64);
    let file = given("bomb.csv.gz", |file| file.write_all(&bomb).unwrap());
    let parts = [
        "bomb.csv.gz",
        ": decompressed content is more than 16 MiB, must be",
        "at most 16 MiB, or 100 times",
    ];
    assert_told(&file.path, &parts);
}

#[test]
fn zeros_behind_the_start_of_a_recording_exceed_the_ratio() {
    let mut head = format!("{:<124}", "MATLAB 5.0 MAT-file").into_bytes();
    head.extend([0, 1, b'I', b'M']);
    let bombs = [
        ("bomb.mat.gz", gzip(&head, &vec![0; 16 * MIB], 64)),
        ("bomb.zip", zip(&head, &vec![0; 16 * MIB], 1)),
    ];
    for (name, bomb) in bombs {
        let file = given(name, |file| file.write_all(&bomb).unwrap());
        let parts = [
            "bomb",
            ": decompressed content is more than 16 MiB, must be",
            "at most 16 MiB, or 100 times",
        ];
        assert_told(&file.path, &parts);
    }
}

#[test]
fn zeros_in_a_zip_archive_are_no_recording() {
    let bomb = zip(&[], &vec![0; 16 * MIB], 4);
    let file = given("bomb.zip", |file| file.write_all(&bomb).unwrap());
    assert_told(&file.path, &["bomb.zip", "at least one recording"]);
}

/// Regression: the table of the archive took 2.5 GB of memory.
#[test]
fn table_of_a_huge_zip_archive_without_compression_is_refused() {
    let start = "ground,roof\n".to_owned() + &"0.5,1.5\n".repeat(10_000);
    let file = given("huge.zip", |file| {
        write_sparse_zip(file, &start, 800_000_000)
    });
    let parts = [
        "huge.zip/table.csv",
        "decompressed content is more than 24 MiB in total",
        "extract the archive first",
    ];
    assert_told(&file.path, &parts);
}

/// Regression: the archive and its table took 1.8 GB of memory.
#[test]
fn table_in_a_zip_archive_is_read_as_a_stream() {
    let start = "ground,roof\n".to_owned() + &"0.5,1.5\n".repeat(10_000);
    let file = given("large.zip", |file| {
        write_sparse_zip(file, &start, 20_000_000)
    });
    assert_told(&file.path, &["large.zip/table.csv:10002: row has no end"]);
}

/// Writes a zip archive of one stored file with this number of bytes. Behind its start, it has
/// zeros, which need no space on the disk.
fn write_sparse_zip(file: &mut File, start: &str, bytes: u32) {
    const NAME: &[u8] = b"table.csv";
    let words = |words: &[u16]| -> Vec<u8> { words.iter().flat_map(|w| w.to_le_bytes()).collect() };
    // The checksum is 0, which is wrong, because nobody should read so far.
    let sizes = [0, bytes, bytes].map(u32::to_le_bytes).concat();
    let name_bytes = words(&[NAME.len() as u16]);
    let version = words(&[20, 0, 0, 0, 0]);
    let head = [
        b"PK\x03\x04",
        &version[..],
        &sizes,
        &name_bytes,
        &[0; 2],
        NAME,
    ]
    .concat();
    let made_by = words(&[20]);
    let entry = [
        b"PK\x01\x02",
        &made_by[..],
        &version,
        &sizes,
        &name_bytes,
        &[0; 16],
        NAME,
    ]
    .concat();
    let at = head.len() as u32 + bytes;
    let place = [entry.len() as u32, at].map(u32::to_le_bytes).concat();
    let end = [b"PK\x05\x06", &words(&[0, 0, 1, 1])[..], &place, &[0; 2]].concat();
    file.write_all(&[&head, start.as_bytes()].concat()).unwrap();
    file.seek(SeekFrom::Start(at.into())).unwrap();
    file.write_all(&[entry, end].concat()).unwrap();
}

#[test]
fn sparse_table_has_a_row_without_end() {
    let file = given("sparse.csv", |file| {
        file.write_all("0.5,1.5\n".repeat(10_000).as_bytes())
            .unwrap();
        file.set_len(3 << 30).unwrap();
    });
    let parts = ["sparse.csv:10001: row has no end within 1048576 bytes"];
    assert_told(&file.path, &parts);
    let zeros = given("zeros.csv", |file| file.set_len(3 << 30).unwrap());
    assert_told(&zeros.path, &["zeros.csv", "unknown format"]);
}

#[test]
fn endless_line_is_refused_wherever_it_is() {
    let mapping = ColumnMapping::by_name(["a"]);
    for (before, letter, line) in [
        ("", b'a', 1),
        ("time,a\n", b'1', 2),
        ("time,a\n0,1\n0.1,2\n", b'"', 4),
        ("time a\n0 1\n", b' ', 3),
        ("time,a\n0,1\n0.1,\"", b'\n', 3),
    ] {
        let told = bounded(|| {
            let input = Cursor::new(before).chain(std::io::repeat(letter));
            let mut reader = CsvReader::new(Box::new(input), Path::new("hall.csv"), &mapping)?;
            while reader.next_row()?.is_some() {}
            Ok(())
        });
        let expected = format!(
            "hall.csv:{line}: row has no end within 1048576 bytes, must have at most 1048576 bytes"
        );
        assert_eq!(told, expected, "{before:?}");
    }
}

#[test]
fn long_rows_and_many_columns_up_to_the_limit_are_read() {
    let header: Vec<String> = (1..10_000)
        .map(|number| format!("{:0>99}", format!("c{number}")))
        .collect();
    let row = vec!["1"; 9_999].join(",");
    let text = format!("time,{}\n0,{row}\n0.01,{row}\n", header.join(","));
    let file = given("wide.csv", |file| file.write_all(text.as_bytes()).unwrap());
    let read = RecordedFile::read(&file.path, &ReadOptions::default()).unwrap();
    assert_eq!(read.channels().len(), 9_999);
    assert_eq!(read.channels()[9_998].name(), header[9_998]);
}

#[test]
fn hundred_thousand_columns_are_refused() {
    let header: Vec<String> = (1..=100_000).map(|number| format!("c{number}")).collect();
    let row = vec!["1"; 100_000].join(",");
    let text = format!("{}\n{row}\n", header.join(","));
    let file = given("wide.csv", |file| file.write_all(text.as_bytes()).unwrap());
    let parts = ["wide.csv:1: has 100000 columns, must have at most 10000"];
    assert_told(&file.path, &parts);
}

#[cfg(unix)]
#[test]
fn pipes_and_devices_are_refused_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("pipe.csv");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.unwrap().success());
    for path in [pipe.as_path(), Path::new("/dev/zero")] {
        let expected = format!(
            "{}: is a pipe, a device or a socket, must be a regular file or a folder",
            path.display()
        );
        assert_eq!(refusals(path), [expected.clone(), expected]);
    }
}
