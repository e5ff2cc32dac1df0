use super::*;
use crate::credibility::loss_as_modelled;
use crate::probability_of_loss;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Normal};

fn record(mean: f64, std: f64) -> RecordSummary {
    RecordSummary::from_estimates(vec![[(mean, std)]; 50]).unwrap()
}

fn estimated(records: &[RecordSummary]) -> Result<Baseline, AlertError> {
    Baseline::from_records("tower", &["storey-1"], records, BetweenRecords::Estimated)
}

fn stated(records: &[RecordSummary], std: f64) -> Result<Baseline, AlertError> {
    Baseline::from_records("tower", &["storey-1"], records, BetweenRecords::Stated(std))
}

fn estimate(mean: f64, std: f64) -> ParameterEstimate {
    ParameterEstimate {
        time_ns: 0,
        mean,
        std,
    }
}

#[test]
fn variance_between_records_increases_the_reference_variance() {
    // m = 0.9, 1.0, 1.1: b² = 0.01, and s_r² = 0.01·4/3.
    let records = [record(0.9, 0.02), record(1.0, 0.02), record(1.1, 0.02)];
    let reference = estimated(&records).unwrap().reference("storey-1").unwrap();
    assert!((reference.mean() - 1.0).abs() < 1e-12);
    assert!(
        (reference.std().powi(2) - 0.013_333_333_333).abs() < 1e-9,
        "{}",
        reference.std()
    );
    assert_eq!(reference.scatter().unwrap().degrees_of_freedom, 2.0);
}

#[test]
fn one_record_gives_no_reference_without_a_stated_deviation() {
    let baseline = estimated(&[record(0.9, 0.02)]).unwrap();
    assert!(matches!(
        baseline.claim("storey-1"),
        Some(Err(AlertError::OneRecord))
    ));
    assert!(
        baseline
            .for_structure("storey-1", &estimate(0.9, 0.02))
            .is_none()
    );
    assert_eq!(baseline.parameter("storey-1").unwrap().between_std, None);
}

#[test]
fn one_record_gives_a_reference_with_a_stated_deviation() {
    // σ_b = 0.05, v = 0.02², n = 1: s_r² = 2·0.0025 + 0.0004.
    let baseline = stated(&[record(0.9, 0.02)], 0.05).unwrap();
    let reference = baseline.reference("storey-1").unwrap();
    assert!((reference.std().powi(2) - 0.0054).abs() < 1e-12);
    assert!(reference.scatter().is_none());
}

#[test]
fn stated_deviation_that_the_records_contradict_is_rejected() {
    // b = 0.0707 with one degree of freedom: χ²/1 = 50 for a stated scatter of 0.01, and 2 for
    // 0.05.
    let records = [record(0.9, 1e-6), record(1.0, 1e-6)];
    let error = stated(&records, 0.01).unwrap_err();
    assert!(
        std::error::Error::source(&error)
            .unwrap()
            .to_string()
            .contains("0.0707"),
        "{error:?}"
    );
    assert!(stated(&records, 0.05).is_ok());
    // The probability of exceeding χ² = 10.828 with one degree of freedom, or 16.266 with three, is
    // 0.001 (Abramowitz & Stegun 1964, table 26.8).
    assert!(
        (largest_mean_square(1.0) - 10.828).abs() < 1e-3,
        "{}",
        largest_mean_square(1.0)
    );
    assert!(
        (3.0 * largest_mean_square(3.0) - 16.266).abs() < 1e-3,
        "{}",
        largest_mean_square(3.0)
    );
}

#[test]
fn two_records_far_apart_give_no_reference() {
    let baseline = estimated(&[record(0.3, 0.01), record(1.0, 0.01)]).unwrap();
    assert!(
        matches!(
            baseline.claim("storey-1"),
            Some(Err(AlertError::FewRecords { .. }))
        ),
        "{baseline:?}"
    );
    assert!(baseline.reference("storey-1").is_none());
    // Ten records determine a smaller scatter well enough.
    let ten: Vec<RecordSummary> = (0..10)
        .map(|i| record(0.7 + 0.3 * f64::from(i % 2), 0.01))
        .collect();
    assert!(estimated(&ten).unwrap().reference("storey-1").is_some());
}

/// Sound records exceed a bound of 0.99 in 1 % of cases if the scatter is normal.
///
/// The share is lower if the records themselves are uncertain, because that uncertainty counts
/// twice. 20 000 draws give 1 % ± 0.07 %.
#[test]
fn bound_of_99_percent_is_exceeded_by_about_one_percent_of_sound_records() {
    const DRAWS: u32 = 20_000;
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let between = Normal::new(0.0, 0.01).unwrap();
    for n in [2_usize, 3, 5, 10] {
        for (within_std, least) in [(1e-5, 0.008), (0.003, 0.004), (0.01, 0.0005)] {
            let within = Normal::new(0.0, within_std).unwrap();
            let mut show = || 1.0 + between.sample(&mut random) + within.sample(&mut random);
            let mut exceeded = 0;
            for _ in 0..DRAWS {
                let spans: Vec<SpanSummary> = (0..n)
                    .map(|_| SpanSummary {
                        mean: show(),
                        estimate_variance: within_std * within_std,
                        drift_variance: 0.0,
                    })
                    .collect();
                let parameter = join_spans("storey-1", &spans, BetweenRecords::Estimated).unwrap();
                let further = estimate(show(), within_std);
                // Too few records for a reference never raise an alert.
                let reference = parameter.reference(n).ok();
                let probability =
                    reference.map_or(0.0, |known| probability_of_loss(&further, &known, 0.0));
                exceeded += u32::from(probability >= 0.99);
            }
            let share = f64::from(exceeded) / f64::from(DRAWS);
            assert!(
                (least..0.012).contains(&share),
                "{n} records, within ±{within_std}: {share}"
            );
        }
    }
}

/// The limit on the scatter has little effect for the scatter of real structures.
///
/// With two records and a true scatter of 10 %, 2.2 % of sound records exceed a bound of 0.99. 20
/// 000 draws determine that share to 0.1 %.
#[test]
fn at_most_2_5_percent_of_sound_records_exceed_the_99_percent_bound_at_large_deviations() {
    const DRAWS: u32 = 20_000;
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for (n, scatter) in [(2_usize, 0.05), (2, 0.1), (3, 0.05), (3, 0.1)] {
        let between = Normal::new(1.0, scatter).unwrap();
        let mut exceeded = 0;
        for _ in 0..DRAWS {
            let mut span = || SpanSummary {
                mean: between.sample(&mut random),
                estimate_variance: 1e-10,
                drift_variance: 0.0,
            };
            let spans: Vec<SpanSummary> = (0..n).map(|_| span()).collect();
            let further = estimate(span().mean, 1e-5);
            let reference = join_spans("storey-1", &spans, BetweenRecords::Estimated)
                .unwrap()
                .reference(n)
                .ok();
            let probability =
                reference.map_or(0.0, |known| probability_of_loss(&further, &known, 0.0));
            exceeded += u32::from(probability >= 0.99);
        }
        let share = f64::from(exceeded) / f64::from(DRAWS);
        assert!(
            (0.008..0.025).contains(&share),
            "{n} records, scatter {scatter}: {share}"
        );
    }
}

#[test]
fn interval_of_a_loss_ends_where_its_probability_is_0_975_and_0_025() {
    for records in [
        vec![0.99, 1.01],
        vec![0.95, 1.0, 1.02],
        vec![0.9, 1.0, 1.1, 1.05, 0.97],
    ] {
        let records: Vec<RecordSummary> =
            records.into_iter().map(|mean| record(mean, 0.01)).collect();
        let reference = estimated(&records).unwrap().reference("storey-1").unwrap();
        for found in [estimate(0.7, 0.01), estimate(1.0, 0.05), estimate(0.1, 0.1)] {
            let interval = loss_as_modelled(&found, &reference);
            let at_low = probability_of_loss(&found, &reference, interval.low);
            let at_high = probability_of_loss(&found, &reference, interval.high);
            assert!(
                (at_low - 0.975).abs() < 1e-9 && (at_high - 0.025).abs() < 1e-9,
                "{at_low} {at_high}"
            );
            assert!(interval.low < interval.loss && interval.loss < interval.high);
        }
    }
}

#[test]
fn two_records_have_a_wider_99_percent_bound_than_ten() {
    // Two records differ by 0.03, with the scatter limited to 0.25: a bound of 0.99 lies 0.24935
    // below (a sum over σ by hand). Without the limit it would be 31.8·0.026. For ten records with
    // the same b, it is 2.82·0.0222.
    let two = estimated(&[record(0.985, 0.001), record(1.015, 0.001)])
        .unwrap()
        .reference("storey-1")
        .unwrap();
    let ten: Vec<RecordSummary> = (0..10)
        .map(|i| record(if i % 2 == 0 { 0.98 } else { 1.02 }, 0.001))
        .collect();
    let ten = estimated(&ten).unwrap().reference("storey-1").unwrap();
    let few = two.largest_credible(0.2, 0.99).unwrap();
    assert!((few - 0.8 * (1.0 - 0.24935)).abs() < 1e-3, "{few}");
    let many = ten.largest_credible(0.2, 0.99).unwrap();
    assert!(
        (many - 0.8 * (1.0 - 2.821 * 0.021_082 * 1.1_f64.sqrt())).abs() < 1e-4,
        "{many}"
    );
    assert!(Reference::DESIGN.largest_credible(0.2, 0.99) == Some(0.8));
}

#[test]
fn interval_for_the_structure_holds_the_scatter_between_records() {
    // b = 0.001 with two degrees of freedom: 0.975 point of Student 4.303 (Abramowitz & Stegun
    // 1964, table 26.10)
    let baseline =
        estimated(&[record(0.999, 1e-5), record(1.0, 1e-5), record(1.001, 1e-5)]).unwrap();
    let interval = baseline
        .for_structure("storey-1", &estimate(0.95, 1e-8))
        .unwrap();
    assert!(
        (interval.high - 0.95 - 0.004_303).abs() < 1e-5
            && (0.95 - interval.low - 0.004_303).abs() < 1e-5,
        "{interval:?}"
    );
    let known = stated(&[record(0.9, 0.03)], 0.04).unwrap();
    let interval = known
        .for_structure("storey-1", &estimate(0.95, 0.03))
        .unwrap();
    assert!(
        (interval.high - 0.95 - 1.959_964 * 0.05).abs() < 1e-4,
        "{interval:?}"
    );
}

#[test]
fn file_reads_back_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("baseline.json");
    for written in [
        estimated(&[record(0.9, 0.02), record(0.95, 0.03)]).unwrap(),
        estimated(&[record(0.9, 0.02)]).unwrap(),
        stated(&[record(0.9, 0.02)], 0.04).unwrap(),
    ] {
        written.write(&path).unwrap();
        assert_eq!(Baseline::read(&path).unwrap(), written);
    }
}

fn version_1(records: usize, between_std: f64) -> String {
    format!(
        r#"{{"format":"spandrel.baseline.v1","structure":"tower","records":{records},"parameters":[
        {{"parameter":"storey-1","mean":1.0,"std":0.05,"within_std":0.03,"between_std":{between_std}}}]}}"#
    )
}

#[test]
fn file_of_version_1_gives_a_reference_only_if_its_records_suffice() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("baseline.json");
    std::fs::write(&path, version_1(3, 0.04)).unwrap();
    let three = Baseline::read(&path).unwrap();
    assert!(three.is_old_file());
    let scatter = three.reference("storey-1").unwrap().scatter().unwrap();
    assert_eq!(
        (
            scatter.degrees_of_freedom,
            three.parameter("storey-1").unwrap().between_std
        ),
        (2.0, Some(0.04))
    );
    for (records, between_std) in [(1, 0.0), (2, 0.4)] {
        std::fs::write(&path, version_1(records, between_std)).unwrap();
        assert!(
            Baseline::read(&path)
                .unwrap()
                .reference("storey-1")
                .is_none(),
            "{records} records"
        );
    }
}

#[test]
fn error_names_both_versions_of_a_file_of_another_version() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("baseline.json");
    std::fs::write(
        &path,
        r#"{"format":"spandrel.baseline.v9","structure":"a","records":1,"parameters":[]}"#,
    )
    .unwrap();
    let message = Baseline::read(&path).unwrap_err().to_string();
    assert!(
        message.contains("spandrel.baseline.v9") && message.contains("spandrel.baseline.v3"),
        "{message}"
    );
}

#[test]
fn parameter_too_uncertain_to_be_a_reference_is_named() {
    let error = estimated(&[record(0.9, 0.5)]).unwrap_err();
    assert!(error.to_string().contains("storey-1"), "{error}");
}

#[test]
fn frames_of_unequal_length_give_no_record() {
    assert!(RecordSummary::from_estimates([vec![(1.0, 0.1)], vec![]]).is_none());
    assert!(RecordSummary::from_estimates([vec![(1.0, 0.1)], vec![(1.0, 0.1); 2]]).is_none());
    assert!(RecordSummary::from_estimates(Vec::<Vec<(f64, f64)>>::new()).is_none());
}

#[test]
fn file_contains_sensor_references_and_the_change_without_each_sensor() {
    let sensor = |gain| SensorReference {
        channel: "roof".to_owned(),
        gain,
        ln_gain_std: 0.03,
        delay_s: 0.002,
        delay_std_s: 0.003,
        profile: None,
    };
    let records = [record(1.0, 0.01), record(1.1, 0.01)];
    // Without the roof, the parameter changes by 0.03 and −0.05: √((9 + 25)/2)·10⁻², times
    // √(1 + 1/2) for a further record.
    let without = [Some(record(1.03, 0.01)), Some(record(1.05, 0.01))];
    let baseline = estimated(&records)
        .unwrap()
        .with_sensors(vec![sensor(0.9)])
        .with_left_out("roof", &records, &without)
        .with_left_out("floor", &records, &[None, None]);
    let change = baseline.change_without("roof", "storey-1").unwrap();
    assert!(
        (change - (17e-4_f64 * 1.5).sqrt()).abs() < 1e-12,
        "{change}"
    );
    assert_eq!(
        baseline.change_without("floor", "storey-1"),
        None,
        "no record shows it"
    );
    assert_eq!(baseline.change_without("cellar", "storey-1"), None);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("baseline.json");
    baseline.write(&path).unwrap();
    assert_eq!(Baseline::read(&path).unwrap(), baseline);

    let impossible = |baseline: &Baseline| {
        baseline.write(&path).unwrap();
        Baseline::read(&path).unwrap_err().to_string()
    };
    let message = impossible(&baseline.clone().with_sensors(vec![sensor(0.0)]));
    assert!(
        message.contains("the sensor roof is impossible"),
        "{message}"
    );
    let mut wrong = baseline;
    wrong.without_sensor[0].changes.push(0.1);
    let message = impossible(&wrong);
    assert!(
        message.contains("without the sensor roof") && message.contains("must be 1"),
        "{message}"
    );
}

#[test]
fn file_of_version_2_has_no_sensors() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("baseline.json");
    let text = r#"{"format":"spandrel.baseline.v2","structure":"house","records":2,"parameters":[
        {"parameter":"storey-1","mean":1.0,"within_std":0.01,"between_std":0.02,"degrees_of_freedom":1.0}]}"#;
    std::fs::write(&path, text).unwrap();
    let baseline = Baseline::read(&path).unwrap();
    assert!(baseline.sensors().is_empty() && !baseline.is_old_file());
    assert!((baseline.parameter("storey-1").unwrap().mean - 1.0).abs() < 1e-12);
}

#[test]
fn parameters_that_are_left_out_do_not_shift_the_changes_of_the_others() {
    let record = |storeys: [f64; 3]| {
        let frame = storeys.map(|mean| (mean, 0.01));
        RecordSummary::from_estimates([frame]).unwrap()
    };
    let kept = [0, 2];
    let records = [record([1.0, 9.0, 0.8])].map(|one| one.of_parameters(&kept));
    let without = [Some(record([1.01, 5.0, 0.83]).of_parameters(&kept))];
    let names = ["storey-1", "storey-3"];
    let baseline =
        Baseline::from_records("tower", &names, &records, BetweenRecords::Stated(0.1)).unwrap();
    let baseline = baseline.with_left_out("roof", &records, &without);
    assert!((baseline.parameter("storey-3").unwrap().mean - 0.8).abs() < 1e-12);
    // One record: its change times √(1 + 1).
    let change = |name| baseline.change_without("roof", name);
    assert!((change("storey-1").unwrap() - 0.01 * 2.0_f64.sqrt()).abs() < 1e-12);
    assert!((change("storey-3").unwrap() - 0.03 * 2.0_f64.sqrt()).abs() < 1e-12);
    assert_eq!(change("storey-2"), None);
}
