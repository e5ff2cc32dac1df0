use std::io::Write;

use super::*;
use crate::unpacked::UnpackingBudget;

/// Reads a file with a budget of its own.
fn read(bytes: &[u8]) -> Result<Vec<RecordedChannel>, Fault> {
    super::read(bytes, &UnpackingBudget::of_file())
}

/// A writer of elements in one byte order.
struct Writer {
    is_big: bool,
    bytes: Vec<u8>,
}

impl Writer {
    fn words(&self, words: &[u32]) -> Vec<u8> {
        words
            .iter()
            .flat_map(|word| {
                if self.is_big {
                    word.to_be_bytes()
                } else {
                    word.to_le_bytes()
                }
            })
            .collect()
    }

    fn doubles(&self, values: &[f64]) -> Vec<u8> {
        values
            .iter()
            .flat_map(|value| {
                if self.is_big {
                    value.to_be_bytes()
                } else {
                    value.to_le_bytes()
                }
            })
            .collect()
    }

    fn element(&self, kind: u32, data: &[u8]) -> Vec<u8> {
        let mut element = self.words(&[kind, data.len() as u32]);
        element.extend(data);
        element.resize(element.len().next_multiple_of(8), 0);
        element
    }

    fn array(&self, class: u32, shape: &[u32], name: &str, parts: &[Vec<u8>]) -> Vec<u8> {
        let head = [
            self.element(6, &self.words(&[class, 0])),
            self.element(5, &self.words(shape)),
            self.element(1, name.as_bytes()),
        ];
        self.element(MATRIX, &[head.concat(), parts.concat()].concat())
    }

    fn matrix(&self, name: &str, rows: u32, columns: u32, values: &[f64]) -> Vec<u8> {
        self.array(
            6,
            &[rows, columns],
            name,
            &[self.element(9, &self.doubles(values))],
        )
    }

    fn text(&self, name: &str, text: &str) -> Vec<u8> {
        self.array(
            4,
            &[1, text.len() as u32],
            name,
            &[self.element(16, text.as_bytes())],
        )
    }

    fn cells(&self, name: &str, texts: &[&str]) -> Vec<u8> {
        let cells: Vec<Vec<u8>> = texts.iter().map(|text| self.text("", text)).collect();
        self.array(1, &[1, texts.len() as u32], name, &cells)
    }

    fn structures(&self, name: &str, fields: &[&str], elements: &[Vec<Vec<u8>>]) -> Vec<u8> {
        let names: Vec<u8> = fields
            .iter()
            .flat_map(|field| format!("{field:\0<16}").into_bytes())
            .collect();
        let head = [self.element(5, &self.words(&[16])), self.element(1, &names)];
        self.array(
            2,
            &[1, elements.len() as u32],
            name,
            &[head.concat(), elements.concat().concat()],
        )
    }

    fn file(mut self, variables: &[Vec<u8>]) -> Vec<u8> {
        let mut header = format!("{:<124}", "MATLAB 5.0 MAT-file").into_bytes();
        header.extend(if self.is_big {
            [1, 0, b'M', b'I']
        } else {
            [0, 1, b'I', b'M']
        });
        self.bytes.extend(header);
        self.bytes.extend(variables.concat());
        self.bytes
    }
}

fn writer(is_big: bool) -> Writer {
    Writer {
        is_big,
        bytes: Vec::new(),
    }
}

/// Returns two sensors with two components and five samples each, and times at 20 Hz.
fn variables(writer: &Writer) -> Vec<Vec<u8>> {
    let values: Vec<f64> = (0..10).map(f64::from).collect();
    let sensor = |name: &str, scale: f64| {
        let values: Vec<f64> = values.iter().map(|value| value * scale).collect();
        vec![
            writer.text("", name),
            writer.cells("", &["x", "y"]),
            writer.cells("", &["g", "m/s2"]),
            writer.matrix("", 5, 2, &values),
        ]
    };
    let fields = ["sensor_name", "component_names", "component_units", "data"];
    let sensors = writer.structures("", &fields, &[sensor("2S", 1.0), sensor("2N", -1.0)]);
    let times = writer.matrix("", 5, 1, &[0.0, 0.05, 0.1, 0.15, 0.2]);
    vec![writer.structures("recording", &["t", "sensor"], &[vec![times, sensors]])]
}

fn compressed(writer: &Writer, variable: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(variable).unwrap();
    let data = encoder.finish().unwrap();
    [writer.words(&[COMPRESSED, data.len() as u32]), data].concat()
}

#[test]
fn structures_with_names_units_and_times_are_read_in_both_byte_orders() {
    for is_big in [false, true] {
        let writer = writer(is_big);
        let variables = variables(&writer);
        let channels = read(&writer.file(&variables)).unwrap();
        let names: Vec<&str> = channels.iter().map(RecordedChannel::name).collect();
        assert_eq!(names, ["2S.x", "2S.y", "2N.x", "2N.y"]);
        assert_eq!(
            channels[3].samples().collect::<Vec<_>>(),
            [-5.0, -6.0, -7.0, -8.0, -9.0]
        );
        assert_eq!(
            (channels[0].unit(), channels[1].unit()),
            (Some("g"), Some("m/s2"))
        );
        assert!((channels[0].sampling_rate_hz().unwrap() - 20.0).abs() < 1e-9);
    }
}

#[test]
fn compressed_variables_equal_plain_variables() {
    let writer = writer(false);
    let plain = variables(&writer);
    let packed: Vec<Vec<u8>> = plain
        .iter()
        .map(|variable| compressed(&writer, variable))
        .collect();
    let packed = self::writer(false).file(&packed);
    assert_eq!(read(&packed).unwrap(), read(&writer.file(&plain)).unwrap());
}

#[test]
fn matrix_without_times_is_read_along_its_longer_side_at_the_stated_rate() {
    let writer = writer(false);
    let values: Vec<f64> = (0..8).map(f64::from).collect();
    let variables = [
        writer.matrix("fs", 1, 1, &[100.0]),
        writer.matrix("acc", 2, 4, &values),
    ];
    let channels = read(&writer.file(&variables)).unwrap();
    assert_eq!(
        (channels[1].name(), channels[1].sampling_rate_hz()),
        ("acc.2", Some(100.0))
    );
    assert_eq!(
        channels[1].samples().collect::<Vec<_>>(),
        [1.0, 3.0, 5.0, 7.0]
    );
}

#[test]
fn version_7_3_is_refused_by_name() {
    let mut file = writer(false).file(&[]);
    file[124..126].copy_from_slice(&[0, 2]);
    let told = read(&file).unwrap_err().to_string();
    assert!(
        told.contains("version of the MAT-file is 0200") && told.contains("7.3 is HDF5"),
        "{told}"
    );
}

#[test]
fn shape_with_too_few_values_is_rejected() {
    let writer = writer(false);
    for (rows, columns) in [(5, 3), (u32::MAX >> 1, u32::MAX >> 1)] {
        let variables = [writer.matrix("acc", rows, columns, &[1.0, 2.0, 3.0, 4.0])];
        let told = read(&self::writer(false).file(&variables))
            .unwrap_err()
            .to_string();
        assert!(told.contains("number of values is 4"), "{told}");
    }
}

#[test]
fn deeply_nested_cells_are_rejected() {
    let writer = writer(false);
    let mut variable = writer.matrix("", 3, 1, &[1.0, 2.0, 3.0]);
    for _ in 0..100 {
        variable = writer.array(1, &[1, 1], "deep", &[variable]);
    }
    let told = read(&writer.file(&[variable])).unwrap_err().to_string();
    assert!(told.contains("depth of cells and structures"), "{told}");
}

#[test]
fn file_cut_anywhere_is_refused_or_lacks_whole_variables() {
    let writer = writer(false);
    let matrix = writer.matrix("acc", 4, 1, &[1.0, 2.0, 3.0, 4.0]);
    let packed = compressed(&writer, &variables(&writer)[0]);
    let first = 128 + matrix.len();
    let file = writer.file(&[matrix, packed]);
    for end in 0..file.len() {
        match read(&file[..end]) {
            Ok(channels) => assert!(end == first && channels.len() == 1, "cut at {end}"),
            Err(_) => assert!(end != first, "cut at {end}"),
        }
    }
}

#[test]
fn damaged_byte_is_an_error_or_other_values_but_no_panic() {
    let writer = writer(false);
    let variables = variables(&writer);
    let file = writer.file(&variables);
    for place in 0..file.len() {
        for damage in [0x01, 0x80, 0xff] {
            let mut damaged = file.clone();
            damaged[place] ^= damage;
            let _ = read(&damaged);
        }
    }
}
