use super::*;

/// Returns a dataset with the given first line, header values (data type, number of values,
/// spacing) and values.
fn dataset(first: &str, data: &str, values: &[u8]) -> Vec<u8> {
    let mut file =
        format!("    -1\n{first}\nsensor one\nhall\n18-Apr-16 13:49:58\nNONE\nNONE\n").into_bytes();
    file.extend(
        b"    1         0    0         0 deck              12  -3 NONE               0   0\n",
    );
    file.extend(data.as_bytes());
    file.extend(b"\n        17    0    0    0 time                 s                   \n");
    file.extend("        12    0    0    0 Acceleration         m/s²                \n".as_bytes());
    file.extend(b"         0    0    0    0 NONE                 NONE                \n");
    file.extend(b"         0    0    0    0 NONE                 NONE                \n");
    file.extend(values);
    file.extend(b"    -1\n");
    file
}

const EVEN: &str = "         2         8         1  0.50000E+00  2.00000E-02  0.00000E+00";
const TOUCHING: &str = "-1.47553E-002-1.72957E-002-1.66101E-002-1.61988E-002-1.68925E-002-1.53669E-002\n 1.00000E+000 2.00000E+000\n";

fn text_file() -> Vec<u8> {
    dataset("    58", EVEN, TOUCHING.as_bytes())
}

fn binary_file(order: ByteOrder) -> Vec<u8> {
    let values = [-1.5_f32, 2.5, f32::NAN, 4.0, 5.0, 6.0, 7.0, 8.0];
    let bytes: Vec<u8> = match order {
        ByteOrder::Little => values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect(),
        ByteOrder::Big => values
            .iter()
            .flat_map(|value| value.to_be_bytes())
            .collect(),
    };
    let code = if order == ByteOrder::Little { 1 } else { 2 };
    let first = format!(
        "    58b     {code}     2          11          32     0     0           0           0"
    );
    dataset(&first, EVEN, &bytes)
}

#[test]
fn touching_values_name_unit_and_start_are_read() {
    let channels = read(&text_file()).unwrap();
    let channel = &channels[0];
    assert_eq!(
        (channel.name(), channel.unit()),
        ("deck.12.-z", Some("m/s²"))
    );
    assert!((channel.sampling_rate_hz().unwrap() - 50.0).abs() < 1e-12);
    let samples: Vec<f64> = channel.samples().collect();
    assert_eq!(
        (samples.len(), samples[1], samples[7]),
        (8, -1.72957e-2, 2.0)
    );
    // Source: `date -u -d '2016-04-18T13:49:58Z' +%s`, plus the first abscissa of half a second.
    assert_eq!(channel.start_ns(), Some(1_460_987_398_500_000_000));
}

#[test]
fn both_byte_orders_are_read_and_nan_is_missing() {
    for order in [ByteOrder::Little, ByteOrder::Big] {
        let channels = read(&binary_file(order)).unwrap();
        let samples: Vec<f64> = channels[0].samples().collect();
        assert_eq!((samples[0], samples[1], samples[7]), (-1.5, 2.5, 8.0));
        assert!(samples[2].is_nan());
    }
}

#[test]
fn uneven_abscissae_give_their_rate_and_gap() {
    let uneven = "         4         4         0  0.00000E+00  0.00000E+00  0.00000E+00";
    let values = "  0.00000E+00  1.000000000000E+00  1.00000E-02  2.000000000000E+00\n  \
                  2.00000E-02  3.000000000000E+00  5.00000E-02  4.000000000000E+00\n";
    let channels = read(&dataset("    58", uneven, values.as_bytes())).unwrap();
    assert_eq!(channels[0].segments().len(), 2);
    assert_eq!(channels[0].sampling_rate_hz(), Some(100.0));
    assert_eq!(channels[0].gaps()[0].samples, 2);
}

#[test]
fn repeated_degrees_of_freedom_are_numbered() {
    let channels = read(&text_file().repeat(3)).unwrap();
    let names: Vec<&str> = channels.iter().map(RecordedChannel::name).collect();
    assert_eq!(names, ["deck.12.-z", "deck.12.-z#2", "deck.12.-z#3"]);
}

#[test]
fn other_datasets_are_skipped_and_alone_are_an_error() {
    let units = b"    -1\n   164\n         1SI\n    -1\n".to_vec();
    assert_eq!(
        read(&[units.clone(), text_file()].concat()).unwrap().len(),
        1
    );
    let told = read(&units).unwrap_err().to_string();
    assert_eq!(
        told,
        "content is dataset 164, must be a time response in a dataset 58 or 58b"
    );
}

#[test]
fn wrong_line_of_values_names_its_place() {
    let file = String::from_utf8(text_file())
        .unwrap()
        .replace(" 2.00000E+000", " 2.0x000E+000");
    let told = read(file.as_bytes()).unwrap_err().to_string();
    assert!(
        told.contains("line of values is ` 1.00000E+000 2.0x000E+000`, must be 2 numbers"),
        "{told}"
    );
}

#[test]
fn file_cut_anywhere_is_refused() {
    for file in [text_file(), binary_file(ByteOrder::Big)] {
        for end in 0..file.len() - 1 {
            assert!(read(&file[..end]).is_err(), "cut at {end}");
        }
    }
}

#[test]
fn claimed_number_of_values_is_not_allocated() {
    let claimed = EVEN.replace("         8", " 999999999");
    let told = read(&dataset("    58", &claimed, TOUCHING.as_bytes()))
        .unwrap_err()
        .to_string();
    assert!(told.contains("line of values"), "{told}");
}
