use std::io::{Cursor, Write};

use proptest::prelude::*;

use super::*;
use crate::{OffsetRemoval, RecordReader, Recording, Resampling, TimeOrigin, TimeSource};

const TABLE: &str = "time,roof,base\n0.00,1,5\n0.01,2,6\n0.02,3,7\n";

fn at2(first: f64) -> String {
    let head = "PEER STRONG MOTION DATABASE RECORD\nHILL\n\
                ACCELERATION TIME HISTORY IN UNITS OF G\nNPTS= 2, DT= .01000 SEC\n";
    format!("{head}{first:>15.7E}{:>15.7E}\n", -0.5)
}

fn zip_of(members: &[(&str, &[u8])]) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, content) in members {
        archive
            .start_file(*name, zip::write::SimpleFileOptions::default())
            .unwrap();
        archive.write_all(content).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

fn gzip_of(content: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(content).unwrap();
    encoder.finish().unwrap()
}

fn read_as(name: &str, bytes: &[u8]) -> Result<RecordedFile, RecordError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    RecordedFile::read(&path, &ReadOptions::default())
}

fn names(file: &RecordedFile) -> Vec<&str> {
    file.channels().iter().map(RecordedChannel::name).collect()
}

#[test]
fn archive_returns_its_recordings_and_lists_skipped_files() {
    let (east, west) = (at2(0.25), at2(0.75));
    let members = [
        ("east.at2", east.as_bytes()),
        ("west.at2", west.as_bytes()),
        ("ReadMe.txt", b"Channels east and west"),
    ];
    let file = read_as("event.zip", &zip_of(&members)).unwrap();
    assert_eq!(names(&file), ["east/acceleration", "west/acceleration"]);
    assert_eq!(
        file.channels()[1].samples().collect::<Vec<_>>(),
        [0.75, -0.5]
    );
    assert_eq!(file.remarks(), ["skipped, unknown format: ReadMe.txt"]);
}

const GOOD_CLOCK: &str = "Start time: 11/20/08, 19:23: 1.3 UTC (WWVB)";
const LOW_QUALITY: &str =
    "Record of Thu Nov 20, 2008 11:23:22.1 PST\nStart time: 11/20/08, 19:23 GMT (*LoQ*)";
const LOW_QUALITY_WITHOUT_ZONE: &str = "Start time: 7/04/19, 17:35:07.3(*LoQ*)";
const NO_CLOCK: &str = "Record of Fri Jul 5, 2019 20:19 PDT";
/// Source: `date -u -d '2008-11-20T19:23:01Z' +%s`
const GOOD_START_NS: i64 = 1_227_208_981_300_000_000;

/// Returns a CSMIP file of channels with these numbers, lines of time and first samples.
fn csmip(channels: &[(u32, &str, f64)]) -> String {
    let mut text = String::new();
    for (number, time, first) in channels {
        text += &format!("Corrected accelerogram\n{time}\nChan {number}: Up   Location: Deck\n");
        text += " 2 points of accel data equally spaced at 0.010 sec, in cm/sec2. (8f10.5)\n";
        text += &format!("{first:10.5}{:10.5}\n", 0.5);
        text += &format!("/&  ----------  End of data for channel  {number}  ----------\n");
    }
    text
}

/// Returns the archive of these files of one channel each.
fn archive_of(channels: &[(u32, &str, f64)]) -> RecordedFile {
    let files: Vec<(String, String)> = channels
        .iter()
        .map(|channel| (format!("CHAN{:03}.V2", channel.0), csmip(&[*channel])))
        .collect();
    let members: Vec<(&str, &[u8])> = files
        .iter()
        .map(|(name, text)| (name.as_str(), text.as_bytes()))
        .collect();
    read_as("event.zip", &zip_of(&members)).unwrap()
}

fn starts(file: &RecordedFile) -> Vec<(TimeOrigin, Option<i64>)> {
    let of_channel = |channel: &RecordedChannel| (channel.origin(), channel.start_ns());
    file.channels().iter().map(of_channel).collect()
}

#[test]
fn channels_of_a_low_quality_clock_start_with_the_others() {
    let channels = [
        (1, LOW_QUALITY, 1.0),
        (2, NO_CLOCK, 2.0),
        (5, GOOD_CLOCK, 3.0),
        (6, GOOD_CLOCK, 4.0),
    ];
    let assumed = "time of a low-quality clock, or no time; assumed to start with the first sample \
        of the others: channel-1, channel-2";
    let whole = read_as("event.v2", csmip(&channels).as_bytes()).unwrap();
    for file in [archive_of(&channels), whole] {
        let expected = [(TimeOrigin::Epoch, Some(GOOD_START_NS)); 4];
        assert_eq!(starts(&file), expected);
        assert_eq!(
            (file.remarks(), file.doubts()),
            ([assumed.to_owned()].as_slice(), file.remarks())
        );
    }
}

#[test]
fn channels_of_low_quality_clocks_alone_start_together() {
    let later = LOW_QUALITY.replace("23:22.1", "24:20.0");
    let file = archive_of(&[(1, &later, 1.0), (2, LOW_QUALITY, 2.0)]);
    // Source: `date -u -d '2008-11-20T11:23:22-08:00' +%s`
    let start = (TimeOrigin::Epoch, Some(1_227_209_002_100_000_000));
    assert_eq!(starts(&file), [start; 2]);
    assert!(file.doubts()[0].ends_with("assumed to start together: channel-1, channel-2"));
    let undated = archive_of(&[(1, LOW_QUALITY_WITHOUT_ZONE, 1.0), (2, NO_CLOCK, 2.0)]);
    assert_eq!(starts(&undated), [(TimeOrigin::Start, Some(0)); 2]);
    assert_eq!(undated.doubts(), file.doubts());
    let same = archive_of(&[(1, LOW_QUALITY, 1.0), (2, LOW_QUALITY, 2.0)]);
    assert_eq!(
        (starts(&same), same.doubts()),
        (starts(&file), [].as_slice())
    );
}

#[test]
fn channels_of_good_clocks_far_apart_are_kept_and_named() {
    let later = GOOD_CLOCK.replace(" 1.3", " 2.4");
    let file = archive_of(&[(1, GOOD_CLOCK, 1.0), (2, &later, 2.0)]);
    assert_eq!(starts(&file)[1].1, Some(GOOD_START_NS + 1_100_000_000));
    let told = "channels start at different times: channel-2.acceleration 1.1 s after \
        channel-1.acceleration";
    assert_eq!(file.doubts(), [told]);
    let later = GOOD_CLOCK.replace(" 1.3", " 2.2");
    assert!(
        archive_of(&[(1, GOOD_CLOCK, 1.0), (2, &later, 2.0)])
            .doubts()
            .is_empty()
    );
}

#[test]
fn low_quality_times_of_several_events_are_not_aligned() {
    let (one, other) = (
        csmip(&[(1, LOW_QUALITY, 1.0)]),
        csmip(&[(1, GOOD_CLOCK, 2.0)]),
    );
    let members = [("one.v2", one.as_bytes()), ("other.v2", other.as_bytes())];
    let file = read_as("events.zip", &zip_of(&members)).unwrap();
    assert_eq!(
        names(&file),
        ["one/channel-1.acceleration", "other/channel-1.acceleration"]
    );
    assert_ne!(starts(&file)[0], starts(&file)[1]);
}

#[test]
fn file_that_repeats_the_channels_of_others_is_skipped() {
    let channels = [(1, GOOD_CLOCK, 1.0), (2, GOOD_CLOCK, 2.0)];
    let (first, second) = (csmip(&channels[..1]), csmip(&channels[1..]));
    let read = |whole: &str| {
        let members = [
            ("ALL.V2", whole.as_bytes()),
            ("CHAN001.V2", first.as_bytes()),
            ("CHAN002.V2", second.as_bytes()),
        ];
        read_as("event.zip", &zip_of(&members)).unwrap()
    };
    let file = read(&csmip(&channels));
    assert_eq!(
        names(&file),
        ["channel-1.acceleration", "channel-2.acceleration"]
    );
    let told = "skipped, other files have the same channels and samples: ALL.V2";
    assert_eq!(file.remarks(), [told]);
    let other = read(&csmip(&[channels[0], (2, GOOD_CLOCK, 2.00001)]));
    // One sample of channel 2 differs.
    let both = [
        "ALL/channel-2.acceleration",
        "CHAN002/channel-2.acceleration",
    ];
    assert_eq!(
        (names(&other)[0], &names(&other)[1..]),
        ("channel-1.acceleration", both.as_slice())
    );
}

#[test]
fn unique_channel_names_have_no_prefix() {
    let file = read_as(
        "event.zip",
        &zip_of(&[("a.at2", at2(0.25).as_bytes()), ("b.csv", TABLE.as_bytes())]),
    )
    .unwrap();
    assert_eq!(names(&file), ["acceleration", "roof", "base"]);
}

#[test]
fn damaged_member_is_refused_with_its_own_name() {
    let told = read_as(
        "event.zip",
        &zip_of(&[("east.at2", &at2(0.25).as_bytes()[..125])]),
    )
    .unwrap_err()
    .to_string();
    assert!(
        told.contains("event.zip/east.at2: PEER AT2: line "),
        "{told}"
    );
}

#[test]
fn archive_without_recordings_is_refused() {
    let told = read_as("event.zip", &zip_of(&[("ReadMe.txt", b"nothing here")]))
        .unwrap_err()
        .to_string();
    assert!(
        told.ends_with("content is ReadMe.txt, must be at least one recording of a known format"),
        "{told}"
    );
}

#[test]
fn archive_cut_anywhere_is_refused() {
    let archive = zip_of(&[
        ("east.at2", at2(0.25).as_bytes()),
        ("b.csv", TABLE.as_bytes()),
    ]);
    for end in 0..archive.len() {
        assert!(
            read_as("event.zip", &archive[..end]).is_err(),
            "cut at {end}"
        );
    }
}

#[test]
fn nesting_of_archives_is_limited() {
    let mut archive = zip_of(&[("a.csv", TABLE.as_bytes())]);
    for _ in 0..2 {
        archive = zip_of(&[("inner.zip", &archive)]);
    }
    assert_eq!(
        names(&read_as("event.zip", &archive).unwrap()),
        ["roof", "base"]
    );
    let told = read_as("event.zip", &zip_of(&[("inner.zip", &archive)]))
        .unwrap_err()
        .to_string();
    assert!(
        told.contains("depth of archives in archives is 4, must be at most 3"),
        "{told}"
    );
}

#[test]
fn compressed_table_is_read_by_rows_and_whole() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("hall.csv.gz");
    std::fs::write(&path, gzip_of(TABLE.as_bytes())).unwrap();
    let mut recording = Recording::open(
        &path,
        &ColumnMapping::by_name(["base"]),
        OffsetRemoval::Keep,
    )
    .unwrap();
    assert_eq!(recording.next_row().unwrap().unwrap().values, [5.0]);
    let file = RecordedFile::read(&path, &ReadOptions::default()).unwrap();
    assert_eq!(
        (names(&file), file.channels()[0].sampling_rate_hz()),
        (vec!["roof", "base"], Some(100.0))
    );
}

#[test]
fn zipped_and_resampled_tables_are_read_as_the_table_itself() {
    let folder = tempfile::tempdir().unwrap();
    // The mapping contains the exact name of the column.
    let table = TABLE.replace("roof", "roof [g]");
    let (plain, zipped) = (
        folder.path().join("hall.csv"),
        folder.path().join("hall.zip"),
    );
    std::fs::write(&plain, &table).unwrap();
    std::fs::write(&zipped, zip_of(&[("hall.csv", table.as_bytes())])).unwrap();
    let column = crate::ChannelColumn::new("roof")
        .with_column("roof [g]")
        .in_unit_of_file(crate::Quantity::Acceleration);
    let mapping = ColumnMapping::new(vec![column]);
    let rows = |path: &Path, resampling| {
        let mut recording =
            Recording::open_resampled(path, &mapping, OffsetRemoval::Keep, resampling).unwrap();
        let mut rows = Vec::new();
        while let Some(row) = recording.next_row().unwrap() {
            rows.push((row.time_ns, row.values.to_vec()));
        }
        rows
    };
    let expected = rows(&plain, Resampling::None);
    assert_eq!(expected[2], (20_000_000, vec![3.0 * 9.80665]));
    assert_eq!(rows(&zipped, Resampling::None), expected);
    assert_eq!(
        rows(&plain, Resampling::To { rate_hz: 100.0 }),
        expected,
        "at its own rate nothing is done"
    );
    assert_eq!(rows(&plain, Resampling::To { rate_hz: 50.0 }).len(), 2);
}

#[test]
fn folder_is_read_in_the_order_of_names() {
    let folder = tempfile::tempdir().unwrap();
    for (name, first) in [("b.at2", 0.25), ("a.at2", 0.75)] {
        std::fs::write(folder.path().join(name), at2(first)).unwrap();
    }
    let file = RecordedFile::read(folder.path(), &ReadOptions::default()).unwrap();
    assert_eq!(
        (names(&file), file.format()),
        (vec!["a/acceleration", "b/acceleration"], Format::Folder)
    );
    let mapping =
        ColumnMapping::by_name(["b/acceleration"]).with_time(TimeSource::Counted { rate_hz: 1.0 });
    let mut recording = Recording::open(folder.path(), &mapping, OffsetRemoval::Keep).unwrap();
    assert_eq!(
        recording.check_sampling_rate(100.0).unwrap(),
        100.0,
        "a rate that is stated counts"
    );
    assert_eq!(recording.next_row().unwrap().unwrap().values, [0.25]);
}

#[test]
fn declared_rate_is_for_channels_without_one() {
    let options = ReadOptions {
        sampling_rate_hz: Some(50.0),
        ..ReadOptions::default()
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("hall.dat");
    std::fs::write(&path, "1\t2\n3\t4\n").unwrap();
    let file = RecordedFile::read(&path, &options).unwrap();
    assert_eq!(
        file.channels()[1].timed_samples().collect::<Vec<_>>(),
        [(0, 2.0), (20_000_000, 4.0)]
    );
    let none = ReadOptions {
        sampling_rate_hz: Some(0.0),
        ..ReadOptions::default()
    };
    assert!(matches!(
        RecordedFile::read(&path, &none),
        Err(RecordError::DeclaredRate { .. })
    ));
}

/// File beginnings that identify a format, so that arbitrary bytes reach its reader.
const BEGINNINGS: [&[u8]; 12] = [
    b"",
    b"MS\x03",
    b"000001D TEST 00HNZXX\x07\xe4\0\x01",
    b"TDSm\x0e\0\0\0\x69\x12\0\0",
    b"\x89MCAP0\r\n",
    b"PK\x03\x04",
    &[0x1f, 0x8b, 8],
    b"    -1\n    58\n",
    b"    -1\n    58b     1     2          11          32     0     0           0           0\n",
    b"acc (Format v01.20 with 2 text lines)\nx\n 1 Integer-header values follow on 1 lines, Format= (10I8)\n",
    b"Corrected accelerogram\n 9 points of accel data equally spaced at 0.010 sec, in cm/sec2. (8f10.5)\n",
    b"2 CORRECTED ACCELEROGRAM\n*\n",
];

proptest! {
    #[test]
    fn arbitrary_bytes_are_read_or_refused(
        place in 0..BEGINNINGS.len(),
        bytes in prop::collection::vec(any::<u8>(), 0..400),
        is_text in any::<bool>(),
    ) {
        // Arbitrary bytes are rarely text. Digits, dots and line breaks reach further into text
        // readers.
        let letters = b"0123456789 .-+eE,\n";
        let bytes: Vec<u8> = match is_text {
            true => bytes.iter().map(|byte| letters[usize::from(*byte) % letters.len()]).collect(),
            false => bytes,
        };
        let file = [BEGINNINGS[place], &bytes].concat();
        let source = Source::new(Cursor::new(file)).unwrap();
        let location = FileLocation::of(Path::new("x.csv"));
        let _ = Reading::of(&ReadOptions::default()).source(source, &location);
    }

    #[test]
    fn arbitrary_bytes_in_a_matlab_file_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..400), is_big in any::<bool>()) {
        let mut file = format!("{:<124}", "MATLAB 5.0 MAT-file").into_bytes();
        file.extend(if is_big { [1, 0, b'M', b'I'] } else { [0, 1, b'I', b'M'] });
        file.extend(bytes);
        let source = Source::new(Cursor::new(file)).unwrap();
        let location = FileLocation::of(Path::new("x.mat"));
        let _ = Reading::of(&ReadOptions::default()).source(source, &location);
    }
}
