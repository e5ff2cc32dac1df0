use super::*;

/// A writer of values in one byte order.
#[derive(Clone, Copy)]
struct Writer {
    is_big: bool,
}

impl Writer {
    fn u32(self, value: u32) -> Vec<u8> {
        if self.is_big {
            value.to_be_bytes().to_vec()
        } else {
            value.to_le_bytes().to_vec()
        }
    }

    fn u64(self, value: u64) -> Vec<u8> {
        if self.is_big {
            value.to_be_bytes().to_vec()
        } else {
            value.to_le_bytes().to_vec()
        }
    }

    fn string(self, text: &str) -> Vec<u8> {
        [self.u32(text.len() as u32), text.as_bytes().to_vec()].concat()
    }

    fn double(self, key: &str, value: f64) -> Vec<u8> {
        [self.string(key), self.u32(10), self.u64(value.to_bits())].concat()
    }

    fn text(self, key: &str, value: &str) -> Vec<u8> {
        [self.string(key), self.u32(0x20), self.string(value)].concat()
    }

    /// Returns the start time 2000-01-01T00:00:00.5 UTC.
    fn start(self) -> Vec<u8> {
        let seconds = (946_684_800 + SECONDS_1904_TO_1970) as u64;
        let parts = [self.u64(1 << 63), self.u64(seconds)];
        let value = if self.is_big {
            [parts[1].clone(), parts[0].clone()].concat()
        } else {
            parts.concat()
        };
        [self.string("wf_start_time"), self.u32(0x44), value].concat()
    }

    fn object(self, path: &str, index: Vec<u8>, properties: &[Vec<u8>]) -> Vec<u8> {
        [
            self.string(path),
            index,
            self.u32(properties.len() as u32),
            properties.concat(),
        ]
        .concat()
    }

    fn doubles(self, count: u64) -> Vec<u8> {
        [self.u32(20), self.u32(10), self.u32(1), self.u64(count)].concat()
    }

    fn segment(self, contents: u32, objects: &[Vec<u8>], raw: &[u8]) -> Vec<u8> {
        let metadata = [self.u32(objects.len() as u32), objects.concat()].concat();
        let contents = if self.is_big {
            contents | contents::BIG_ENDIAN
        } else {
            contents
        };
        let mut bytes = [
            b"TDSm".to_vec(),
            contents.to_le_bytes().to_vec(),
            self.u32(4713),
        ]
        .concat();
        bytes.extend(self.u64((metadata.len() + raw.len()) as u64));
        bytes.extend(self.u64(metadata.len() as u64));
        [bytes, metadata, raw.to_vec()].concat()
    }

    fn raw(self, values: &[f64]) -> Vec<u8> {
        values
            .iter()
            .flat_map(|value| self.u64(value.to_bits()))
            .collect()
    }

    /// Returns a segment of two channels with three values each.
    fn two_channels(self, contents: u32, values: &[f64]) -> Vec<u8> {
        let timing = [
            self.double("wf_increment", 0.01),
            self.start(),
            self.text("unit_string", "g"),
        ];
        let group = self.object("/'deck'", self.u32(u32::MAX), &[]);
        let objects = [
            group,
            self.object("/'deck'/'it''s 1'", self.doubles(3), &timing),
            self.object("/'deck'/'2'", self.doubles(3), &[]),
        ];
        self.segment(contents, &objects, &self.raw(values))
    }
}

const LITTLE: Writer = Writer { is_big: false };
const BIG: Writer = Writer { is_big: true };
const WHOLE: u32 = contents::METADATA | contents::NEW_OBJECTS | contents::RAW_DATA;

fn samples(channel: &RecordedChannel) -> Vec<f64> {
    channel.samples().collect()
}

#[test]
fn chunks_of_both_byte_orders_are_read() {
    let values = [
        1.0, 2.0, 3.0, -1.0, -2.0, -3.0, 4.0, 5.0, 6.0, -4.0, -5.0, -6.0,
    ];
    for writer in [LITTLE, BIG] {
        let channels = read(&writer.two_channels(WHOLE, &values)).unwrap();
        assert_eq!(samples(&channels[0]), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(samples(&channels[1]), [-1.0, -2.0, -3.0, -4.0, -5.0, -6.0]);
        assert_eq!(
            (channels[0].name(), channels[0].unit()),
            ("deck/it's 1", Some("g"))
        );
        assert_eq!(
            (
                channels[0].sampling_rate_hz(),
                channels[1].sampling_rate_hz()
            ),
            (Some(100.0), None)
        );
        assert_eq!(channels[0].start_ns(), Some(946_684_800_500_000_000));
    }
}

#[test]
fn interleaved_values_are_read() {
    let file = LITTLE.two_channels(
        WHOLE | contents::INTERLEAVED,
        &[1.0, -1.0, 2.0, -2.0, 3.0, -3.0],
    );
    let channels = read(&file).unwrap();
    assert_eq!(
        (samples(&channels[0]), samples(&channels[1])),
        (vec![1.0, 2.0, 3.0], vec![-1.0, -2.0, -3.0])
    );
}

#[test]
fn segments_without_metadata_continue_the_previous_ones() {
    let values = [1.0, 2.0, 3.0, -1.0, -2.0, -3.0];
    let mut file = LITTLE.two_channels(WHOLE, &values);
    // The second segment contains only raw data, without metadata.
    let raw = LITTLE.raw(&values);
    file.extend(
        [
            b"TDSm".to_vec(),
            contents::RAW_DATA.to_le_bytes().to_vec(),
            LITTLE.u32(4713),
        ]
        .concat(),
    );
    file.extend([LITTLE.u64(raw.len() as u64), LITTLE.u64(0), raw].concat());
    let same = LITTLE.object("/'deck'/'2'", LITTLE.u32(0), &[]);
    file.extend(LITTLE.segment(WHOLE, &[same], &LITTLE.raw(&[7.0, 8.0, 9.0])));
    let channels = read(&file).unwrap();
    assert_eq!(samples(&channels[0]), [1.0, 2.0, 3.0, 1.0, 2.0, 3.0]);
    assert_eq!(
        samples(&channels[1]),
        [-1.0, -2.0, -3.0, -1.0, -2.0, -3.0, 7.0, 8.0, 9.0]
    );
}

/// Returns a DAQmx segment of two 16-bit channels. The first channel has a linear scale on the raw
/// numbers.
fn daqmx() -> Vec<u8> {
    let index = |offset: u32| {
        let scaler = [
            LITTLE.u32(3),
            LITTLE.u32(0),
            LITTLE.u32(offset),
            LITTLE.u32(0),
            LITTLE.u32(0),
        ]
        .concat();
        [
            LITTLE.u32(0x1269),
            LITTLE.u32(u32::MAX),
            LITTLE.u32(1),
            LITTLE.u64(3),
            LITTLE.u32(1),
            scaler,
            LITTLE.u32(1),
            LITTLE.u32(4),
        ]
        .concat()
    };
    let whole =
        |key: &str, value: u32| [LITTLE.string(key), LITTLE.u32(7), LITTLE.u32(value)].concat();
    let scale = [
        whole("NI_Number_Of_Scales", 2),
        LITTLE.text("NI_Scale[1]_Scale_Type", "Linear"),
        LITTLE.double("NI_Scale[1]_Linear_Slope", 0.5),
        LITTLE.double("NI_Scale[1]_Linear_Y_Intercept", 10.0),
        whole("NI_Scale[1]_Linear_Input_Source", 0),
    ];
    let objects = [
        LITTLE.object("/'g'/'a'", index(0), &scale),
        LITTLE.object("/'g'/'b'", index(2), &[]),
    ];
    let raw: Vec<u8> = [1_i16, -1, 2, -2, 3, -3]
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    LITTLE.segment(WHOLE | 1 << 7, &objects, &raw)
}

#[test]
fn daqmx_strides_and_scales_are_read() {
    let channels = read(&daqmx()).unwrap();
    assert_eq!(samples(&channels[0]), [10.5, 11.0, 11.5]);
    assert_eq!(samples(&channels[1]), [-1.0, -2.0, -3.0]);
}

#[test]
fn scale_that_is_not_known_is_refused_by_name() {
    let mut file = daqmx();
    let place = file
        .windows(6)
        .position(|window| window == b"Linear")
        .unwrap();
    // The first `Linear` is the value of Scale_Type.
    file[place..place + 6].copy_from_slice(b"Tables");
    let told = read(&file).unwrap_err().to_string();
    assert!(
        told.contains("scale 1 of g/a is `Tables`, must be Linear or Polynomial"),
        "{told}"
    );
}

#[test]
fn incomplete_segment_after_a_crash_is_read_to_its_end() {
    let values = [1.0, 2.0, 3.0, -1.0, -2.0, -3.0, 4.0, 5.0];
    let mut file = LITTLE.two_channels(WHOLE, &values);
    file[12..20].copy_from_slice(&u64::MAX.to_le_bytes());
    let channels = read(&file).unwrap();
    assert_eq!(
        (samples(&channels[0]).len(), samples(&channels[1]).len()),
        (5, 3)
    );
}

#[test]
fn file_cut_anywhere_is_refused_or_lacks_whole_segments() {
    let one = LITTLE.two_channels(WHOLE, &[1.0, 2.0, 3.0, -1.0, -2.0, -3.0]);
    for (file, first) in [(one.repeat(2), one.len()), (daqmx(), 0)] {
        for end in 0..file.len() {
            match read(&file[..end]) {
                Ok(channels) => assert!(
                    end == first && samples(&channels[0]).len() == 3,
                    "cut at {end}"
                ),
                Err(_) => assert!(end != first || end == 0, "cut at {end}"),
            }
        }
    }
}

#[test]
fn damaged_byte_is_an_error_or_other_values_but_no_panic() {
    for file in [
        LITTLE.two_channels(WHOLE, &[1.0, 2.0, 3.0, -1.0, -2.0, -3.0]),
        daqmx(),
    ] {
        for place in 0..file.len() {
            for damage in [0x01, 0x7f, 0xff] {
                let mut damaged = file.clone();
                damaged[place] ^= damage;
                let _ = read(&damaged);
            }
        }
    }
}
