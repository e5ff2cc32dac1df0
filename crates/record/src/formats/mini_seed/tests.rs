use super::*;
use crate::bytes::ByteOrder;
use crate::recorded::Gap;

/// A writer of records of version 2.
#[derive(Clone)]
struct Writer {
    order: ByteOrder,
    encoding: u8,
    power: u8,
    channel: &'static str,
    /// Time since 2020-01-01T00:00:00, in units of 0.1 ms.
    ticks: u32,
    clock_quality: u8,
}

/// Settings for records of 256 bytes with 32-bit integers at 100 Hz.
const PLAIN: Writer = Writer {
    order: ByteOrder::Big,
    encoding: 3,
    power: 8,
    channel: "HNZ",
    ticks: 0,
    clock_quality: 100,
};

impl Writer {
    fn u16(&self, value: u16) -> [u8; 2] {
        if self.order == ByteOrder::Big {
            value.to_be_bytes()
        } else {
            value.to_le_bytes()
        }
    }

    fn u32(&self, value: u32) -> [u8; 4] {
        if self.order == ByteOrder::Big {
            value.to_be_bytes()
        } else {
            value.to_le_bytes()
        }
    }

    fn record(&self, count: u16, data: &[u8]) -> Vec<u8> {
        let mut bytes = format!("000001D TEST 00{}XX", self.channel).into_bytes();
        bytes.splice(7..7, *b" "); // the reserved byte
        bytes.remove(8);
        bytes.extend([self.u16(2020), self.u16(1)].concat());
        bytes.extend([0, 0, (self.ticks / 10_000) as u8, 0]);
        bytes.extend(
            [
                self.u16((self.ticks % 10_000) as u16),
                self.u16(count),
                self.u16(100),
                self.u16(1),
            ]
            .concat(),
        );
        bytes.extend([0, 0, 0, 2]);
        bytes.extend(
            [
                self.u32(0).to_vec(),
                self.u16(64).to_vec(),
                self.u16(48).to_vec(),
            ]
            .concat(),
        );
        bytes.extend([self.u16(1000), self.u16(56)].concat());
        bytes.extend([
            self.encoding,
            u8::from(self.order == ByteOrder::Big),
            self.power,
            0,
        ]);
        bytes.extend([self.u16(1001), self.u16(0)].concat());
        bytes.extend([self.clock_quality, 42, 0, 0]); // 42 µs
        bytes.extend(data);
        bytes.resize(1 << self.power, 0);
        bytes
    }

    fn integers(&self, values: &[i32]) -> Vec<u8> {
        let data: Vec<u8> = values
            .iter()
            .flat_map(|value| self.u32(*value as u32))
            .collect();
        self.record(values.len() as u16, &data)
    }

    /// Returns the same settings for a record that starts `ticks` of 0.1 ms after the beginning.
    fn after(&self, ticks: u32) -> Self {
        Self {
            ticks,
            ..self.clone()
        }
    }

    fn words(&self, words: &[u32]) -> Vec<u8> {
        words.iter().flat_map(|word| self.u32(*word)).collect()
    }
}

fn samples(file: &[u8]) -> Vec<f64> {
    read(file).unwrap()[0].samples().collect()
}

/// Source: `date -u -d '2020-01-01T00:00:00Z' +%s`
const START_NS: i64 = 1_577_836_800_000_000_000;

#[test]
fn header_of_either_byte_order_is_read() {
    for order in [ByteOrder::Big, ByteOrder::Little] {
        let channels = read(&Writer { order, ..PLAIN }.integers(&[7, -8, 9])).unwrap();
        let channel = &channels[0];
        assert_eq!(channel.samples().collect::<Vec<_>>(), [7.0, -8.0, 9.0]);
        assert_eq!(
            (channel.name(), channel.sampling_rate_hz(), channel.unit()),
            ("XX.TEST.00.HNZ", Some(100.0), Some("counts"))
        );
        assert_eq!(channel.start_ns(), Some(START_NS + 42_000));
    }
}

#[test]
fn all_plain_encodings_are_read() {
    let of = |encoding: u8, data: &[u8]| samples(&Writer { encoding, ..PLAIN }.record(2, data));
    assert_eq!(of(1, &[0, 5, 0xff, 0xfb]), [5.0, -5.0]);
    assert_eq!(of(2, &[0, 0, 5, 0xff, 0xff, 0xfb]), [5.0, -5.0]);
    assert_eq!(
        of(
            4,
            &[1.5_f32.to_be_bytes(), (-2.5_f32).to_be_bytes()].concat()
        ),
        [1.5, -2.5]
    );
    assert_eq!(
        of(
            5,
            &[1.5_f64.to_be_bytes(), (-2.5_f64).to_be_bytes()].concat()
        ),
        [1.5, -2.5]
    );
}

/// Returns a frame of level 1: words 1 and 2 are the first and last sample, followed by differences
/// of 8, 16 and 32 bits.
fn steim_1(writer: &Writer, last: i32) -> Vec<u8> {
    let codes = 0b01 << 24 | 0b10 << 22 | 0b11 << 20;
    let mut data = writer.words(&[codes, 1000, last as u32]);
    // The first difference, here 99, refers to the previous record and is ignored.
    data.extend([99, 1, 0xfe, 3]);
    data.extend([writer.u16(300), writer.u16(0xfe0c)].concat());
    data.extend(writer.words(&[70_000]));
    Writer {
        encoding: 10,
        ..writer.clone()
    }
    .record(7, &data)
}

#[test]
fn steim_1_is_decompressed() {
    for order in [ByteOrder::Big, ByteOrder::Little] {
        let found = samples(&steim_1(&Writer { order, ..PLAIN }, 70_802));
        assert_eq!(
            found,
            [1000.0, 1001.0, 999.0, 1002.0, 1302.0, 802.0, 70_802.0]
        );
    }
}

#[test]
fn steim_2_is_decompressed() {
    // Seven differences of 4 bits, six of 5, five of 6, three of 10, two of 15, one of 30.
    let codes = 0b11 << 24 | 0b11 << 22 | 0b11 << 20 | 0b10 << 18 | 0b10 << 16 | 0b10 << 14;
    let pack = |kind: u32, bits: u32, values: &[i32]| {
        values.iter().fold(kind, |word, value| {
            word << bits | (*value as u32 & ((1 << bits) - 1))
        })
    };
    let groups: [(u32, u32, &[i32]); 6] = [
        (2, 4, &[0, 1, -1, 7, -8, 2, 3]),
        (1, 5, &[15, -16, 1, 2, 3, 4]),
        (0, 6, &[31, -32, 1, 2, 3]),
        (3, 10, &[511, -512, 5]),
        (2, 15, &[16_383, -16_384]),
        (1, 30, &[-500_000]),
    ];
    let mut expected = vec![100.0];
    for difference in groups
        .iter()
        .flat_map(|(_, _, values)| values.iter())
        .skip(1)
    {
        expected.push(expected.last().unwrap() + f64::from(*difference));
    }
    let last = *expected.last().unwrap() as i32;
    let mut words = vec![codes, 100, last as u32];
    words.extend(groups.iter().map(|(kind, bits, values)| {
        let used = bits * values.len() as u32;
        let word = pack(0, *bits, values);
        kind << 30 | (word & ((1_u64 << used) - 1) as u32)
    }));
    words.resize(16, 0);
    let file = Writer {
        encoding: 11,
        ..PLAIN
    }
    .record(expected.len() as u16, &PLAIN.words(&words));
    assert_eq!(samples(&file), expected);
}

#[test]
fn wrong_last_sample_is_an_error() {
    let told = read(&steim_1(&PLAIN, 5)).unwrap_err().to_string();
    assert_eq!(
        told,
        "byte 72: last sample as decompressed is 70802, must be 5 as the record states"
    );
}

#[test]
fn records_out_of_order_are_joined_and_gaps_remain() {
    let first = PLAIN.integers(&[1, 2, 3]);
    let second = PLAIN.after(300).integers(&[4, 5]);
    let third = PLAIN.after(900).integers(&[6]);
    let channels = read(&[third, second, first].concat()).unwrap();
    assert_eq!(channels.len(), 1);
    assert_eq!(
        channels[0].samples().collect::<Vec<_>>(),
        [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    );
    let gap = Gap {
        after_ns: START_NS + 42_000 + 40_000_000,
        samples: 4,
    };
    assert_eq!(channels[0].gaps(), [gap]);
}

#[test]
fn repeated_record_counts_once_and_a_contradiction_is_refused() {
    let first = PLAIN.integers(&[1, 2, 3]);
    assert_eq!(samples(&first.repeat(2)), [1.0, 2.0, 3.0]);
    let overlapping = PLAIN.after(200).integers(&[3, 4]);
    assert_eq!(
        samples(&[first.clone(), overlapping].concat()),
        [1.0, 2.0, 3.0, 4.0]
    );
    let other = PLAIN.after(200).integers(&[9, 4]);
    let told = read(&[first, other].concat()).unwrap_err().to_string();
    assert!(
        told.starts_with(
            "byte 256: record of XX.TEST.00.HNZ is different samples for times that already have \
             samples"
        ),
        "{told}"
    );
}

#[test]
fn channels_are_distinguished() {
    let other = Writer {
        channel: "HNE",
        ..PLAIN
    };
    let channels = read(
        &[
            PLAIN.integers(&[1]),
            other.integers(&[2]),
            PLAIN.after(100).integers(&[3]),
        ]
        .concat(),
    )
    .unwrap();
    let names: Vec<&str> = channels.iter().map(RecordedChannel::name).collect();
    assert_eq!(names, ["XX.TEST.00.HNZ", "XX.TEST.00.HNE"]);
    assert_eq!(channels[0].samples().collect::<Vec<_>>(), [1.0, 3.0]);
}

#[test]
fn blockette_that_refers_to_itself_is_rejected() {
    let mut file = PLAIN.integers(&[1, 2]);
    file[50..52].copy_from_slice(&48_u16.to_be_bytes());
    let told = read(&file).unwrap_err().to_string();
    assert_eq!(
        told,
        "byte 50: next blockette is byte 48 of the record, must be from byte 52 on"
    );
}

/// Returns a record of version 3 with 32-bit integers.
fn version_3(values: &[i32], rate: f64) -> Vec<u8> {
    version_3_with(values, rate, b"")
}

/// Returns such a record with extra headers.
fn version_3_with(values: &[i32], rate: f64, extra_headers: &[u8]) -> Vec<u8> {
    let identifier = b"FDSN:XX_TEST_00_H_N_Z";
    let mut bytes = b"MS\x03\0".to_vec();
    bytes.extend(123_456_789_u32.to_le_bytes());
    bytes.extend([2020_u16.to_le_bytes(), 1_u16.to_le_bytes()].concat());
    bytes.extend([0, 0, 0, 3]);
    bytes.extend(rate.to_le_bytes());
    bytes.extend([(values.len() as u32).to_le_bytes(), [0; 4]].concat());
    bytes.extend([1, identifier.len() as u8]);
    bytes.extend((extra_headers.len() as u16).to_le_bytes());
    bytes.extend((4 * values.len() as u32).to_le_bytes());
    bytes.extend(identifier);
    bytes.extend(extra_headers);
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    let checksum = record3::checksum(&bytes);
    bytes[28..32].copy_from_slice(&checksum.to_le_bytes());
    bytes
}

#[test]
fn lowest_quality_of_the_clock_is_read() {
    let of = |ticks, clock_quality| {
        let writer = Writer {
            clock_quality,
            ..PLAIN.after(ticks)
        };
        writer.integers(&[1, 2, 3])
    };
    let file = [of(0, 90), of(300, 35), of(600, 80)].concat();
    assert_eq!(read(&file).unwrap()[0].clock_quality(), Some(35));
    // Above the range of the manual.
    assert_eq!(read(&of(0, 101)).unwrap()[0].clock_quality(), None);
    assert_eq!(
        read(&version_3(&[1, 2], 100.0)).unwrap()[0].clock_quality(),
        None
    );
    let extra = br#"{"FDSN":{"Time":{"Quality":87.6}}}"#;
    let stated = version_3_with(&[1, 2], 100.0, extra);
    assert_eq!(read(&stated).unwrap()[0].clock_quality(), Some(88));
}

#[test]
fn version_3_has_nanoseconds_and_periods() {
    let channels = read(&version_3(&[5, -6], -0.01)).unwrap();
    assert_eq!(channels[0].start_ns(), Some(START_NS + 123_456_789));
    assert_eq!(
        (channels[0].name(), channels[0].sampling_rate_hz()),
        ("XX.TEST.00.HNZ", Some(100.0))
    );
    assert_eq!(channels[0].samples().collect::<Vec<_>>(), [5.0, -6.0]);
}

#[test]
fn checksum_of_version_3_detects_a_damaged_byte() {
    let file = version_3(&[5, -6, 7], 100.0);
    for place in 61..file.len() {
        let mut damaged = file.clone();
        damaged[place] ^= 0x10;
        let told = read(&damaged).unwrap_err().to_string();
        assert!(told.starts_with("byte 28: checksum is "), "{place}: {told}");
    }
}

#[test]
fn file_cut_anywhere_is_refused_or_lacks_whole_records() {
    let two = |one: Vec<u8>, other: Vec<u8>| (one.len(), [one, other].concat());
    for (first, file) in [
        two(steim_1(&PLAIN, 70_802), PLAIN.after(700).integers(&[1])),
        two(version_3(&[1, 2], 100.0), PLAIN.integers(&[1])),
        two(PLAIN.integers(&[1]), version_3(&[1, 2], 100.0)),
    ] {
        for end in 0..file.len() {
            match read(&file[..end]) {
                Ok(_) => assert_eq!(end, first, "cut at {end}"),
                Err(_) => assert_ne!(end, first, "cut at {end}"),
            }
        }
    }
}

#[test]
fn damaged_byte_is_an_error_or_other_values_but_no_panic() {
    for file in [
        steim_1(&PLAIN, 70_802),
        PLAIN.integers(&[1, 2, 3]),
        version_3(&[1, 2], 100.0),
    ] {
        for place in 0..file.len() {
            for damage in [0x01, 0x80, 0xff] {
                let mut damaged = file.clone();
                damaged[place] ^= damage;
                let _ = read(&damaged);
            }
        }
    }
}
