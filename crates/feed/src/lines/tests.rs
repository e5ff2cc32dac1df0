use super::*;

fn csv(time: bool) -> LineFormat {
    LineFormat::Csv {
        separator: ';',
        columns: ["t", "ax", "note", "ay"].map(str::to_owned).to_vec(),
        time: time.then(|| TimeField {
            name: "t".to_owned(),
            unit: TimeUnit::Milliseconds,
        }),
        fields: ["ax", "ay"].map(str::to_owned).to_vec(),
    }
}

fn json() -> LineFormat {
    LineFormat::Json {
        time: Some(TimeField {
            name: "t".to_owned(),
            unit: TimeUnit::Seconds,
        }),
        fields: ["ax", "imu.ay"].map(str::to_owned).to_vec(),
    }
}

#[test]
fn datacast_of_the_manual_is_read() {
    let line = "{'EHZ', 1507760140.530, 614, 916, 1095, 1156, 839}";
    let expected = Packet {
        label: "EHZ".to_owned(),
        start_ns: Some(1_507_760_140_530_000_000),
        rate_hz: None,
        values: vec![614.0, 916.0, 1095.0, 1156.0, 839.0],
        clock_quality: None,
    };
    assert_eq!(LineFormat::RaspberryShake.parse(line), Ok(vec![expected]));
}

#[test]
fn malformed_datacast_names_the_part_and_the_value() {
    for (line, expected) in [
        (
            "EHZ, 1, 2",
            "packet: is `EHZ, 1, 2`, must be {'CHANNEL', TIME, COUNTS…}",
        ),
        ("{EHZ, 1, 2}", "channel: is `EHZ`, must be a name in quotes"),
        (
            "{'EHZ', now, 2}",
            "time: is `now`, must be seconds since 1970",
        ),
        ("{'EHZ', 1, 2, x}", "sample: is `x`, must be a number"),
        (
            "{'EHZ', 1}",
            "packet: is `{'EHZ', 1}`, must have at least one sample",
        ),
    ] {
        let fault = LineFormat::RaspberryShake.parse(line).unwrap_err();
        assert_eq!(fault.to_string(), expected, "{line}");
    }
}

#[test]
fn time_of_a_json_line_keeps_its_nanoseconds() {
    let packets = json()
        .parse(r#"{"t": 1507760140.123457, "ax": [1, null, -3e2]}"#)
        .unwrap();
    assert_eq!(packets.len(), 1);
    assert_eq!(packets[0].start_ns, Some(1_507_760_140_123_457_000));
    assert_eq!(packets[0].values[0], 1.0);
    assert!(packets[0].values[1].is_nan());
    assert_eq!(packets[0].values[2], -300.0);
}

#[test]
fn nested_fields_of_json_are_found() {
    let line = r#"{"t": "1970-01-01T00:00:02Z", "imu": {"ay": 4}}"#;
    let packets = json().parse(line).unwrap();
    assert_eq!(
        (packets[0].label.as_str(), packets[0].start_ns),
        ("imu.ay", Some(2_000_000_000))
    );
}

#[test]
fn malformed_json_is_rejected() {
    for line in [
        "{",
        "[1]",
        r#"{"ax": 1}"#,
        r#"{"t": 1}"#,
        r#"{"t": true, "ax": 1}"#,
        r#"{"t": 1, "ax": "x"}"#,
        r#"{"t": 1, "ax": []}"#,
    ] {
        assert!(json().parse(line).is_err(), "{line}");
    }
}

#[test]
fn row_gives_one_sample_of_each_channel() {
    let packets = csv(true).parse("1500; 0.5 ;calm;").unwrap();
    assert_eq!(packets[0].start_ns, Some(1_500_000_000));
    assert_eq!(packets[0].values, [0.5]);
    assert!(packets[1].values[0].is_nan());
    assert_eq!(csv(false).parse("1500;1;x;2").unwrap()[0].start_ns, None);
}

#[test]
fn header_of_a_table_and_blank_lines_have_no_samples() {
    assert_eq!(csv(true).parse("t;ax;note;ay"), Ok(Vec::new()));
    assert_eq!(csv(true).parse("  \r"), Ok(Vec::new()));
}

#[test]
fn row_with_a_wrong_cell_is_rejected() {
    let fault = csv(true).parse("1;2;3").unwrap_err().to_string();
    assert!(
        fault.contains("must have 4 cells (t, ax, note, ay) but has 3"),
        "{fault}"
    );
    let fault = csv(true).parse("1;two;;3").unwrap_err().to_string();
    assert_eq!(fault, "ax: is `two`, must be a number");
    assert!(csv(true).parse("noon;1;;3").is_err());
}

#[test]
fn error_quotes_only_the_beginning_of_a_long_line() {
    let line = "é".repeat(500);
    let fault = LineFormat::RaspberryShake.parse(&line).unwrap_err();
    assert!(fault.to_string().len() < 200);
}
