//! Reads real records in all formats, if they are available, and compares counts, rates and peaks
//! with the figures of their sources.
//!
//! The records are in `shared/data` beside the repository. A page in each folder lists source,
//! licence and figures.

use crate::skip::records_or_skip;
use spandrel_record::{
    Quantity, ReadOptions, RecordError, RecordedChannel, RecordedFile, Spectrum, Statistics,
    TimeOrigin, TimeUnit,
};

fn read(name: &str) -> Option<RecordedFile> {
    Some(RecordedFile::read(&records_or_skip(name)?, &ReadOptions::default()).unwrap())
}

fn channel<'a>(file: &'a RecordedFile, name: &str) -> &'a RecordedChannel {
    let known = || {
        file.channels()
            .iter()
            .map(RecordedChannel::name)
            .collect::<Vec<_>>()
    };
    let found = file
        .channels()
        .iter()
        .find(|channel| channel.name() == name);
    assert!(
        found.is_some(),
        "no channel {name}, the file has {:?}",
        known()
    );
    found.unwrap()
}

fn samples(channel: &RecordedChannel) -> Vec<f64> {
    channel.samples().collect()
}

fn statistics(channel: &RecordedChannel) -> Statistics {
    Statistics::of(channel).unwrap()
}

/// Checks the number of samples without a gap, the rate (Hz), and the peak within a tolerance.
fn check(channel: &RecordedChannel, count: usize, rate_hz: f64, peak: f64, tolerance: f64) {
    let name = channel.name();
    assert_eq!(samples(channel).len(), count, "{name}");
    assert!(channel.gaps().is_empty(), "{name}: {:?}", channel.gaps());
    let found_hz = channel.sampling_rate_hz().unwrap();
    assert!(
        (found_hz - rate_hz).abs() < 1e-9 * rate_hz,
        "{name}: {found_hz} Hz"
    );
    let found = statistics(channel).peak;
    assert!(
        (found - peak).abs() <= tolerance,
        "{name}: peak {found}, stated {peak}"
    );
}

#[test]
fn steim_compressed_mini_seed_of_strong_motion_is_complete() {
    for component in ["HNE", "HNN", "HNZ"] {
        let name = format!(
            "reader-formats/CE.79435.10.{component}__20211220T201310Z__20211220T202040Z.mseed"
        );
        let Some(file) = read(&name) else { return };
        let channel = channel(&file, &format!("CE.79435.10.{component}"));
        assert_eq!(
            (
                samples(channel).len(),
                channel.sampling_rate_hz(),
                channel.gaps().len()
            ),
            (45_000, Some(100.0), 0)
        );
        // The file name states the time span: 20:13:10 to 20:20:40.
        assert_eq!(channel.start_ns().unwrap() / 1_000_000_000, 1_640_031_190);
    }
    let Some(file) =
        read("reader-formats/BK.TCAS.00.HNE__20180829T023318Z__20180829T023648Z.mseed")
    else {
        return;
    };
    let channel = channel(&file, "BK.TCAS.00.HNE");
    assert_eq!(
        (samples(channel).len(), channel.sampling_rate_hz()),
        (42_000, Some(200.0))
    );
}

#[test]
fn reference_mini_seed_is_the_same_in_both_versions_and_byte_orders() {
    let Some(reference) = read("reader-formats/reference-testdata-steim2.mseed2") else {
        return;
    };
    let reference = channel(&reference, "XX.TEST..BHZ");
    assert_eq!(
        (samples(reference).len(), reference.sampling_rate_hz()),
        (499, Some(40.0))
    );
    for name in [
        "reference-testdata-steim2-LE.mseed2",
        "reference-testdata-steim2.mseed3",
    ] {
        let file = read(&format!("reader-formats/{name}")).unwrap();
        assert_eq!(channel(&file, "XX.TEST..BHZ"), reference, "{name}");
    }
    let float = read("reader-formats/reference-testdata-float32.mseed3").unwrap();
    let float = samples(channel(&float, "XX.TEST..BHZ"));
    assert_eq!(float.len(), 500);
    // The same signal as whole counts. Floating-point numbers contain 24 bits of them.
    let worst = |whole: f64| 1.0 + whole.abs() * f64::from(f32::EPSILON) / 2.0;
    assert!(
        float
            .iter()
            .zip(samples(reference))
            .all(|(float, whole)| (float - whole).abs() <= worst(whole))
    );
}

#[test]
fn three_channels_are_distinguished_in_both_versions() {
    let Some(second) = read("reader-formats/testdata-3channel-signal.mseed2") else {
        return;
    };
    let third = read("reader-formats/testdata-3channel-signal.mseed3").unwrap();
    let names: Vec<&str> = second
        .channels()
        .iter()
        .map(RecordedChannel::name)
        .collect();
    assert_eq!(
        names,
        ["IU.COLA.00.LH1", "IU.COLA.00.LH2", "IU.COLA.00.LHZ"]
    );
    for (second, third) in second.channels().iter().zip(third.channels()) {
        assert_eq!(
            (samples(second).len(), second.sampling_rate_hz()),
            (4200, Some(1.0))
        );
        assert_eq!(second, third);
    }
}

#[test]
fn records_out_of_order_give_the_original_series() {
    let Some(mixed) = read("reader-formats/testdata-oneseries-mixedlengths-mixedorder.mseed2")
    else {
        return;
    };
    let whole = read("reader-formats/testdata-3channel-signal.mseed2").unwrap();
    let (mixed, whole) = (
        channel(&mixed, "XX.TEST.00.LHZ"),
        channel(&whole, "IU.COLA.00.LHZ"),
    );
    assert_eq!(
        (mixed.segments().len(), mixed.start_ns()),
        (1, whole.start_ns())
    );
    assert_eq!(samples(mixed), samples(whole)[..samples(mixed).len()]);
    assert!(samples(mixed).len() > 3900);
}

#[test]
fn damaged_blockettes_are_rejected_with_file_and_position() {
    let Some(path) = records_or_skip("reader-formats/testdata-invalid-blockette-offsets.mseed2")
    else {
        return;
    };
    let error = RecordedFile::read(&path, &ReadOptions::default()).unwrap_err();
    assert!(matches!(error, RecordError::Format { .. }));
    let told = error.to_string();
    assert!(
        told.ends_with(
            ": miniSEED: byte 46: next blockette is byte 40 of the record, must be from byte 48 on"
        ),
        "{told}"
    );
}

#[test]
fn cosmos_files_have_the_peaks_of_their_headers() {
    let Some(file) = read("reader-formats/CE23837.V1C") else {
        return;
    };
    assert_eq!(file.channels().len(), 3);
    for (number, peak) in [(1, -0.105_433), (2, 0.048_757), (3, -0.059_022)] {
        check(
            channel(&file, &format!("channel-{number}.acceleration")),
            13_400,
            200.0,
            peak,
            1e-6,
        );
    }
    assert_eq!(statistics(&file.channels()[0]).peak_after_s, Some(31.575));

    let file = read("reader-formats/Cosmos12TimeSeriesTest.v1").unwrap();
    check(&file.channels()[0], 7000, 100.0, -161.962, 1e-3);
    assert_eq!(statistics(&file.channels()[0]).peak_after_s, Some(27.85));

    // The recorder ran at 50 Hz, but the samples in the file are 5 ms apart. The file states their
    // peak at 76.215 s.
    let file = read("reader-formats/us1000hyfh_akbmrp_AKBMR--n.1000hyfh.BNZ.--.acc.V2c").unwrap();
    check(
        channel(&file, "BMR.BNZ.AK.--.acceleration"),
        42_000,
        200.0,
        -6.851_512,
        1e-5,
    );
    assert_eq!(statistics(&file.channels()[0]).peak_after_s, Some(76.215));
}

#[test]
fn csmip_file_of_three_channels_has_the_peaks_of_its_header() {
    let Some(file) = read("reader-formats/ce89486SampleInput.v2") else {
        return;
    };
    assert_eq!(file.channels().len(), 9);
    for (quantity, peak) in [
        ("acceleration", -388.166),
        ("velocity", 34.735),
        ("displacement", 8.228),
    ] {
        check(
            channel(&file, &format!("channel-1.{quantity}")),
            10_100,
            100.0,
            peak,
            5e-4,
        );
    }
    assert_eq!(
        channel(&file, "channel-1.acceleration").quantity(),
        Some((Quantity::Acceleration, 0.01))
    );
}

/// Archive, channels of the station, samples, rate (Hz), and peaks of channels 3 and 7 (cm/s²) as
/// rounded on the page of the folder.
const PAINTER_STREET: [(&str, usize, usize, f64, f64, f64); 7] = [
    (
        "RioDell_14Sep2012_71842255_ce89324p.zip",
        17,
        11_980,
        200.0,
        22.0,
        45.0,
    ),
    (
        "ferndale_28jan2015_72387946_ce89324p.zip",
        17,
        8500,
        100.0,
        84.0,
        251.0,
    ),
    ("nc73821036_ce89324p.zip", 15, 11_346, 100.0, 492.0, 603.0),
    ("nc73821636_ce89324p.zip", 16, 6900, 100.0, 8.0, 34.0),
    ("nc73827571_ce89324p.zip", 16, 8800, 100.0, 613.0, 710.0),
    ("nc73943821_ce89324p.zip", 17, 8300, 100.0, 41.0, 141.0),
    (
        "petrolia_25apr1992_ce89324p.zip",
        20,
        3000,
        50.0,
        439.0,
        844.0,
    ),
];

#[test]
fn archives_of_seven_earthquakes_have_their_channels_and_peaks() {
    for (name, channels, count, rate_hz, base, top) in PAINTER_STREET {
        let Some(file) = read(&format!("painter-street-bridge/{name}")) else {
            return;
        };
        let acceleration: Vec<_> = file
            .channels()
            .iter()
            .filter(|channel| channel.name().ends_with(".acceleration"))
            .collect();
        assert_eq!(
            (acceleration.len(), file.channels().len()),
            (channels, 3 * channels),
            "{name}"
        );
        for (number, peak) in [(3, base), (7, top)] {
            let channel = channel(&file, &format!("channel-{number}.acceleration"));
            let found = statistics(channel).peak.abs();
            assert!(
                (found - peak).abs() <= 0.5,
                "{name}: channel {number}: peak {found}, stated {peak}"
            );
            assert_eq!(channel.sampling_rate_hz(), Some(rate_hz), "{name}");
            // The page states whole seconds.
            let (found, stated) = (samples(channel).len() as f64, count as f64);
            assert!((found - stated).abs() <= rate_hz, "{name}: {found} samples");
        }
    }
}

#[test]
fn universal_files_in_text_and_binary_agree() {
    let Some(text) = read("reader-formats/Sample_UFF58_ascii.uff") else {
        return;
    };
    let binary = read("reader-formats/Sample_UFF58b_bin.uff").unwrap();
    let (text, binary) = (channel(&text, "Mic 01"), channel(&binary, "Mic 01"));
    for channel in [text, binary] {
        assert_eq!(
            (samples(channel).len(), channel.unit()),
            (79_292, Some("Pa"))
        );
        // The increment has six digits.
        assert!((channel.sampling_rate_hz().unwrap() / 65_536.0 - 1.0).abs() < 1e-5);
    }
    let worst = samples(text)
        .iter()
        .zip(samples(binary))
        .fold(0.0, |worst: f64, (one, other)| {
            worst.max((one - other).abs())
        });
    assert!(
        worst < 1e-6,
        "text has six digits of values below 0.15: {worst}"
    );

    let file = read("reader-formats/time-history-not-all-columns-filled.uff").unwrap();
    let last = samples(&file.channels()[0]);
    assert_eq!(
        (last.len(), last[12], file.channels()[0].unit()),
        (13, -5.84096, Some("m/s²"))
    );
}

#[test]
fn tdms_files_of_all_kinds_are_read() {
    let Some(file) = read("reader-formats/raw1.tdms") else {
        return;
    };
    assert_eq!(file.channels().len(), 7);
    for (place, channel) in file.channels().iter().enumerate() {
        assert_eq!(
            (
                samples(channel).len(),
                channel.sampling_rate_hz(),
                channel.unit()
            ),
            (2000, Some(50_000.0), Some("Volts"))
        );
        // A test signal: successive channels are about 0.83 V apart.
        let mean = statistics(channel).mean;
        assert!(
            (mean - 0.06 - 0.82 * place as f64).abs() < 0.1,
            "channel {place}: mean {mean} V"
        );
    }
    let file = read("reader-formats/big_endian.tdms").unwrap();
    assert_eq!(file.channels().len(), 2);
    file.channels()
        .iter()
        .for_each(|channel| check(channel, 3500, 1000.0, statistics(channel).peak, 0.0));

    let file = read("reader-formats/Digital_Input.tdms").unwrap();
    let rates: Vec<_> = file
        .channels()
        .iter()
        .map(|channel| channel.sampling_rate_hz().unwrap().round())
        .collect();
    assert_eq!(
        rates,
        [2000.0, 40.0, 1.0],
        "three groups with rates of their own"
    );
    assert!(
        file.channels()
            .iter()
            .all(|channel| channel.samples().all(|level| level == 0.0 || level == 1.0))
    );

    let file = read("reader-formats/raw_timestamps.tdms").unwrap();
    assert_eq!(
        (
            samples(&file.channels()[0]).len(),
            file.channels()[0].origin()
        ),
        (128, TimeOrigin::Epoch)
    );
}

#[test]
fn folder_of_a_building_in_smc_has_the_peaks_of_its_headers() {
    let Some(file) = read("berkeley-tall-building") else {
        return;
    };
    assert_eq!(file.channels().len(), 14);
    // `pk acc` in the headers has three digits.
    for (place, peak) in [
        ("HN2.NP.4E", -54.3),
        ("HN2.NP.4W", -44.7),
        ("HN2.NP.BE", -42.2),
        ("HN2.NP.BW", -47.0),
        ("HN2.NP.RC", -57.5),
        ("HN2.NP.RE", -51.4),
        ("HN2.NP.RS", 64.4),
        ("HN3.NP.BE", -38.7),
        ("HN3.NP.BW", -29.4),
        ("HN3.NP.RE", -31.5),
        ("HN3.NP.RS", 49.5),
        ("HN3.NP.RW", 35.1),
        ("HNZ.NP.BE", 17.0),
        ("HNZ.NP.BW", 21.5),
    ] {
        check(
            channel(&file, &format!("1103.{place}_a/acceleration")),
            8200,
            200.0,
            peak,
            0.051,
        );
    }
}

#[test]
fn matlab_file_of_a_floating_bridge_has_its_sensors_and_the_dead_ones() {
    let Some(file) = read("bergsoysund-bridge/NTNU142M-2014-11-16_11-02-45_low.mat") else {
        return;
    };
    assert_eq!(file.channels().len(), 30);
    for channel in file.channels() {
        assert_eq!(
            (samples(channel).len(), channel.unit()),
            (13_112, Some("g")),
            "{}",
            channel.name()
        );
        assert!((channel.sampling_rate_hz().unwrap() - 10.0).abs() < 1e-6);
        let is_dead = channel.name().starts_with('6');
        assert_eq!(
            channel.present(),
            if is_dead { 0 } else { 13_112 },
            "{}",
            channel.name()
        );
    }
    let std = |name: &str| statistics(channel(&file, name)).std;
    assert!(
        (0.8e-4..1.5e-4).contains(&std("2S.x"))
            && (5e-4..6.5e-4).contains(&std("3N.y"))
            && (2.9e-4..4.5e-4).contains(&std("4S.z"))
    );
    // All sensors have a distinct peak at 0.615 Hz.
    for sensor in ["2S", "2N", "3S", "3N", "4S", "4N"] {
        let peaks = Spectrum::of(channel(&file, &format!("{sensor}.y")))
            .unwrap()
            .peaks();
        assert!(
            peaks
                .iter()
                .any(|peak| (peak.frequency_hz - 0.615).abs() < 0.005),
            "{sensor}: {peaks:?}"
        );
    }
}

#[test]
fn matlab_file_of_identified_frequencies_agrees_with_its_copy_in_text() {
    let Some(matlab) = read("yonghe-bridge-frequencies/Yonghe_Modal_FDD.mat") else {
        return;
    };
    let text = read("yonghe-bridge-frequencies/yonghe_modal_frequencies.csv").unwrap();
    for mode in 1..=4 {
        let (matlab, text) = (
            channel(&matlab, &format!("freq_fdd.{mode}")),
            channel(&text, &format!("f{mode}_hz")),
        );
        assert_eq!(
            (samples(matlab).len(), matlab.sampling_rate_hz()),
            (216, None)
        );
        assert!(
            samples(matlab)
                .iter()
                .zip(samples(text))
                .all(|(one, other)| (one - other).abs() <= 1e-6)
        );
    }
}

#[test]
fn ground_motion_of_the_peer_database_is_read() {
    let Some(file) = read("ground-motions/IELC180.AT2") else {
        return;
    };
    check(channel(&file, "acceleration"), 4000, 100.0, -0.313, 5e-4);
    assert_eq!(file.channels()[0].unit(), Some("g"));
}

#[test]
fn zipped_table_of_a_load_test_has_its_units_and_peaks() {
    let name = "munich-test-bridge/UniBw_2022-04-11_ref_support_load_01AllM100Hz.csv.zip";
    let Some(file) = read(name) else { return };
    let units: Vec<_> = file
        .channels()
        .iter()
        .map(|channel| channel.unit().unwrap())
        .collect();
    assert_eq!(units, ["g", "um/m", "kN", "deg"]);
    let acceleration = &file.channels()[0];
    check(acceleration, 72_000, 100.0, 0.0064, 5e-5);
    let force = statistics(&file.channels()[2]);
    assert!((233.5..234.5).contains(&force.min) && (245.5..246.5).contains(&force.max));
    assert!((statistics(&file.channels()[1]).mean + 477.0).abs() < 1.0);
    let peaks = Spectrum::of(acceleration).unwrap().peaks();
    for expected_hz in [10.8, 12.7, 16.3] {
        assert!(
            peaks
                .iter()
                .any(|peak| (peak.frequency_hz - expected_hz).abs() < 0.06),
            "{expected_hz} Hz: {peaks:?}"
        );
    }
}

#[test]
fn tables_without_header_are_read_at_a_declared_rate() {
    for name in ["wn_01.dat", "wn_02.dat", "wn_03.dat"] {
        let Some(path) = records_or_skip(&format!("unison-tower/{name}")) else {
            return;
        };
        let options = ReadOptions {
            sampling_rate_hz: Some(100.0),
            ..ReadOptions::default()
        };
        let file = RecordedFile::read(&path, &options).unwrap();
        assert_eq!(file.channels().len(), 8, "{name}");
        file.channels()
            .iter()
            .for_each(|channel| check(channel, 40_960, 100.0, statistics(channel).peak, 0.0));
        // Floors 1 to 3 in m/s², with the factors on the page of the folder.
        for (column, factor) in [("5", 2.0), ("6", 1.0), ("7", 1.0)] {
            let std = factor * statistics(channel(&file, column)).std;
            assert!(
                (0.015..0.055).contains(&std),
                "{name}: column {column}: {std}"
            );
        }
    }
}

#[test]
fn compressed_files_of_a_recorder_are_read_after_their_preamble() {
    let options = ReadOptions {
        time_column: Some("SampleTimeFine".to_owned()),
        time_unit: Some(TimeUnit::Microseconds),
        ..ReadOptions::default()
    };
    let Some(folder) = records_or_skip("mini-shake-table/raw") else {
        return;
    };
    let mut files = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let file = RecordedFile::read(&path, &options).unwrap();
        let name = path.display();
        assert_eq!(file.channels().len(), 10, "{name}");
        let counter = samples(channel(&file, "PacketCounter"));
        assert!(
            counter.windows(2).all(|pair| pair[1] == pair[0] + 1.0),
            "{name}: a packet is lost"
        );
        let rate_hz = channel(&file, "Acc_X").sampling_rate_hz().unwrap();
        assert!((rate_hz - 120.0).abs() < 0.01, "{name}: {rate_hz} Hz");
        files += 1;
    }
    assert_eq!(files, 16);
}

#[test]
fn aligned_shake_table_records_have_the_frequencies_of_their_page() {
    // First mode, top relative to ground: 7.8 to 8.0 Hz with stiff walls, 3.7 to 3.8 Hz with
    // flexible ones.
    for (state, range_hz) in [("stiff", 7.7..8.1), ("flexible", 3.6..3.9)] {
        let Some(file) = read(&format!("mini-shake-table/aligned/{state}-northridge.csv")) else {
            return;
        };
        let top = channel(&file, "floor3_mps2");
        let peak = statistics(top).peak.abs();
        assert!((23.5..27.5).contains(&peak), "{state}: peak {peak} m/s²");
        let peaks = Spectrum::of(top).unwrap().peaks();
        assert!(
            peaks
                .iter()
                .any(|peak| range_hz.contains(&peak.frequency_hz)),
            "{state}: {peaks:?}"
        );
    }
}
