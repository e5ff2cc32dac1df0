use super::*;
use spandrel_bus::{EstimateFlags, Excluded, Header, ModeEstimate, ShapeValue, StreamState};
use std::path::Path;

const EPOCH_S: i64 = 300;
const S: i64 = 1_000_000_000;

/// Returns the example without a measured excitation. Three of its modes are declared.
fn structure() -> Structure {
    let text = include_str!("../../../../docs/examples/output-only.toml");
    let modal = "
[modal]
epoch-s = 300
band-hz = [0.3, 10]

[[modal.mode]]
name = \"sway-1\"
frequency-hz = 1.0

[[modal.mode]]
name = \"sway-2\"
frequency-hz = 2.92

[[modal.mode]]
name = \"sway-3\"
frequency-hz = 4.6
";
    Structure::parse(&format!("{text}{modal}"), Path::new("output-only.toml")).unwrap()
}

fn check() -> ModelCheck {
    ModelCheck::new(&structure()).unwrap().unwrap()
}

/// Returns an estimate per second of an epoch. Each parameter is 1 ± 0.02.
fn estimates(epoch: i64, flags: EstimateFlags) -> EstimateBlock {
    let parameters = structure().parameters().len();
    let triangle = (0..parameters)
        .flat_map(|column| (0..=column).map(move |row| if row == column { 4e-4 } else { 0.0 }));
    let estimate = Estimate {
        mean: vec![1.0; parameters],
        covariance: triangle.collect(),
        noise_mean: vec![],
        noise_covariance: vec![],
        innovations: vec![],
        normalised_innovation_squared: 0.0,
        log_evidence: 0.0,
        used_channels: 5,
        flags,
        excluded: Excluded::None,
        sustained_information: Vec::new(),
    };
    let first = epoch * EPOCH_S;
    EstimateBlock {
        header: Header {
            source: "identify-1".into(),
            epoch: 1,
            sequence: first as u64,
            time_ns: first * S,
        },
        term: 0,
        t0_ns: 0,
        sampling_rate_hz: 1.0,
        parameters: parameters as u16,
        noise_parameters: 0,
        channels: 0,
        estimates: vec![estimate; EPOCH_S as usize],
        state: StreamState::Running,
    }
}

/// Returns the declared modes after an epoch. The first one has `factor` times the frequency of the
/// model.
fn modes(check: &ModelCheck, epoch: i64, factor: f64) -> Vec<ModeDisplay> {
    let x = DVector::zeros(check.parts.len());
    let (frequencies_hz, shapes) = check.model.modes(&x).unwrap();
    let modes = frequencies_hz.iter().zip(shapes.column_iter()).take(3);
    let modes = (1..).zip(modes).map(|(number, (hz, shape))| {
        let hz = if number == 1 { factor * hz } else { *hz };
        let values = shape.iter().zip(&check.channels);
        let values = values.map(|(value, channel)| ShapeValue {
            channel: channel.clone(),
            value: [value / shape.amax(), 0.0],
            std: 0.01,
        });
        ModeDisplay {
            structure: Name::new("output-only").unwrap(),
            mode: Name::new(format!("sway-{number}")).unwrap(),
            time_ns: (epoch + 1) * EPOCH_S * S,
            epoch_s: EPOCH_S as f64,
            epochs: epoch as u64 + 1,
            state: ModeState::Tracked,
            partner: None,
            estimate: Some(ModeEstimate {
                frequency_hz: hz,
                frequency_std_hz: 0.002,
                damping: 0.02,
                damping_std: 0.002,
                shape: values.collect(),
                amplitude: 0.1,
            }),
            presence: 1.0,
            machine: false,
            declared_hz: 1.0,
        }
    });
    modes.collect()
}

/// Processes an epoch, and returns whether the agreement has changed.
fn epoch(check: &mut ModelCheck, number: i64, factor: f64) -> Option<Change> {
    for display in modes(check, number, factor) {
        assert_eq!(check.compare(), None, "before all modes have arrived");
        check.take_mode(display);
    }
    assert_eq!(check.compare(), None, "before the estimates have arrived");
    check.take_estimates(&estimates(number, EstimateFlags::working()));
    let change = check.compare();
    for display in modes(check, number, factor) {
        check.take_mode(display);
    }
    assert_eq!(check.compare(), None, "a repetition counts once");
    change
}

#[test]
fn a_mode_that_differs_in_three_consecutive_epochs_contradicts_the_model() {
    let mut check = check();
    assert_eq!(epoch(&mut check, 0, 1.2), None);
    assert_eq!(epoch(&mut check, 1, 1.2), None);
    assert_eq!(check.contradicting(), None);
    let change = epoch(&mut check, 2, 1.2).unwrap();
    assert_eq!(change.agreement, Agreement::Contradicted);
    assert_eq!((&change.subject[..], change.time_ns), ("sway-1", 900 * S));
    // Five storeys with ± 0.02 each: ln f has the standard deviation of about 0.02/2/√5.
    let told = "mode sway-1 was measured at 1.2000 ± 0.0020 Hz, and the model has it at 1.0000 ± ";
    assert!(change.why.starts_with(told), "{}", change.why);
    assert_eq!(check.contradicting(), Some(&change.why[..]));
    assert_eq!(
        epoch(&mut check, 3, 1.2),
        None,
        "it is the same contradiction"
    );
    let change = epoch(&mut check, 4, 1.0).unwrap();
    assert_eq!(change.agreement, Agreement::Agrees);
    assert_eq!(check.contradicting(), None);
}

#[test]
fn a_change_that_the_filter_follows_sooner_is_no_contradiction() {
    let mut check = check();
    for (number, factor) in [1.2, 1.2, 1.0, 1.2, 1.2, 1.0].into_iter().enumerate() {
        assert_eq!(epoch(&mut check, number as i64, factor), None);
    }
    for number in 6..20 {
        // Three per cent is the error of a usable model.
        assert_eq!(epoch(&mut check, number, 1.03), None);
    }
}

#[test]
fn an_epoch_with_estimates_without_a_meaning_is_not_compared() {
    let jump = EstimateFlags {
        follows_jump: true,
        ..EstimateFlags::working()
    };
    let training = EstimateFlags {
        phase: Phase::Training,
        ..EstimateFlags::working()
    };
    let strong = EstimateFlags {
        strong_motion: Some(1.0),
        ..EstimateFlags::working()
    };
    for flags in [jump, training, strong] {
        let mut check = check();
        for number in 0..5 {
            let mut block = estimates(number, EstimateFlags::working());
            block.estimates[150].flags = flags;
            check.take_estimates(&block);
            for display in modes(&check, number, 1.2) {
                check.take_mode(display);
            }
            assert_eq!(check.compare(), None);
        }
    }
}

#[test]
fn a_contradiction_lasts_over_a_restart_until_an_epoch_ends_it() {
    for (factor, agreement) in [(1.2, None), (1.0, Some(Agreement::Agrees))] {
        let mut check = check();
        check.resume_contradicted();
        assert!(check.contradicting().is_some());
        let change = epoch(&mut check, 0, factor);
        assert_eq!(change.map(|change| change.agreement), agreement);
        assert_eq!(check.contradicting().is_some(), agreement.is_none());
        if let Some(told) = check.contradicting() {
            assert!(told.starts_with("mode sway-1 was measured at"), "{told}");
        }
    }
}

#[test]
fn structures_without_a_comparable_model_are_not_checked() {
    let parse = |text: &str| Structure::parse(text, Path::new("x.toml")).unwrap();
    let ambient = parse(include_str!("../../../../docs/examples/modes/ambient.toml"));
    let sensors = parse(include_str!(
        "../../../../docs/examples/modes/sensors-only.toml"
    ));
    let updated = parse(include_str!(
        "../../../../docs/examples/modes/stiffness.toml"
    ));
    let unfollowed = parse(include_str!("../../../../docs/examples/output-only.toml"));
    for structure in [ambient, sensors, updated, unfollowed] {
        assert!(ModelCheck::new(&structure).unwrap().is_none());
    }
}
