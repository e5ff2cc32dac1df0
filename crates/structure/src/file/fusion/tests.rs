use crate::{PeriodNumbers, Structure};
use spandrel_filter::fusion::{FeedbackRule, Weighting};
use std::path::Path;

const FILE: &str = include_str!("../../../../../docs/examples/forty-storey-building.toml");

/// Reads the file with another `[fusion]` table.
fn with(fusion: &str) -> Result<Structure, String> {
    let (start, end) = (
        FILE.find("[fusion]").unwrap(),
        FILE.find("[simulation]").unwrap(),
    );
    let text = format!("{}[fusion]\n{fusion}\n\n{}", &FILE[..start], &FILE[end..]);
    Structure::parse(&text, Path::new("building.toml")).map_err(|error| error.to_string())
}

#[test]
fn nodes_that_share_samples_observe_all_channels() {
    let structure = with("motion = \"samples\"\nsamples-per-period = 5").unwrap();
    // 10 parameters: 65 numbers of the density; 5 instants of two channels each way, from sixteen
    // nodes.
    let expected = PeriodNumbers {
        sent: 65 + 10,
        received: 65 + 150,
    };
    assert_eq!(structure.numbers_per_period(3), Some(expected));
    let node = structure.local_filter(3).unwrap().unwrap();
    assert_eq!(node.filter().observation_len(), 32);
    assert!(structure.fusion().unwrap().passes_motion_on());
    let structure = with("motion = \"samples\"").unwrap();
    let expected = PeriodNumbers {
        sent: 65 + 20,
        received: 65 + 300,
    };
    assert_eq!(structure.numbers_per_period(0), Some(expected));
}

#[test]
fn motion_is_not_shared_by_default() {
    let structure = with("rate-hz = 2").unwrap();
    let plan = structure.fusion().unwrap();
    assert_eq!(
        (plan.rate_hz(), plan.feedback(), plan.passes_motion_on()),
        (2.0, FeedbackRule::Marginal, false)
    );
    assert_eq!(
        structure
            .local_filter(3)
            .unwrap()
            .unwrap()
            .filter()
            .observation_len(),
        2
    );
}

#[test]
fn waveforms_are_published_on_request_and_change_no_identification() {
    let [with_them, without] = ["rate-hz = 1\nwaveforms = true", "rate-hz = 1"].map(with);
    let [with_them, without] = [with_them.unwrap(), without.unwrap()];
    let publishes = |structure: &Structure| structure.fusion().unwrap().publishes_waveforms();
    assert_eq!((publishes(&with_them), publishes(&without)), (true, false));
    let basis = without.identification_basis();
    assert_eq!(with_them.identification_basis(), basis);
    // A table for this alone is as good as none.
    let alone = with("waveforms = true").unwrap();
    let start = FILE.find("[fusion]").unwrap();
    let end = FILE.find("[simulation]").unwrap();
    let none = format!("{}{}", &FILE[..start], &FILE[end..]);
    let none = Structure::parse(&none, Path::new("building.toml")).unwrap();
    assert_eq!(alone.identification_basis(), none.identification_basis());
}

#[test]
fn weights_of_nodes_are_graded_on_request() {
    let weighting = |fusion| {
        with(fusion)
            .unwrap()
            .fusion()
            .unwrap()
            .detector()
            .unwrap()
            .weighting
    };
    assert_eq!(weighting("rate-hz = 1"), Weighting::AllOrNothing);
    assert_eq!(weighting("weighting = \"graded\""), Weighting::Graded);
    assert_eq!(
        weighting("detector = \"all-at-once\"\nweighting = \"graded\""),
        Weighting::Graded
    );
}

#[test]
fn indivisible_rate_is_one_mistake() {
    let error = with("rate-hz = 7\nmotion = \"samples\"\nsamples-per-period = 50").unwrap_err();
    assert!(
        error.contains("fusion.rate-hz: is 7") && !error.contains("samples-per-period"),
        "{error}"
    );
    let error = with("rate-hz = 250\nmotion = \"samples\"").unwrap_err();
    assert!(
        error.contains("fusion.samples-per-period: is left at 10, must divide 1,"),
        "{error}"
    );
}

#[test]
fn shared_responses_require_a_node_that_measures_some() {
    let accelerations = include_str!("../../../../../docs/examples/demo.toml").replacen(
        "sampling-rate-hz",
        "identification = \"distributed\"\nsampling-rate-hz",
        1,
    );
    let text = format!("{accelerations}\n[fusion]\nmotion = \"responses\"\n");
    let error = Structure::parse(&text, Path::new("demo.toml"))
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("fusion.motion: is \"responses\", must not be given unless a node measures"),
        "{error}"
    );
}

#[test]
fn error_names_the_key_and_the_allowed_values() {
    for (fusion, expected) in [
        (
            "rate-hz = 3",
            "fusion.rate-hz: is 3, must be the sampling rate of each node, such as 250",
        ),
        (
            "motion = \"samples\"\nsamples-per-period = 3",
            "fusion.samples-per-period: is 3, must divide 250, the samples of a node",
        ),
        (
            "rate-hz = 1e-300",
            "fusion.rate-hz: is 1e-300, must be a finite number from 0.001 ",
        ),
        (
            "exclusion = 0.9",
            "fusion.exclusion: is given, must not be given together with detector \
             = \"one-at-a-time\"",
        ),
        (
            "detector = \"none\"\nscreening = 0.9",
            "fusion.screening: is given, must not be given together with detector = \"none\"",
        ),
        (
            "detector = \"none\"\nreadmission = 2",
            "fusion.readmission: is given, must not be given together with detector = \"none\"",
        ),
        (
            "detector = \"none\"\nweighting = \"graded\"",
            "fusion.weighting: is given, must not be given together with detector = \"none\"",
        ),
        (
            "weighting = \"half\"",
            "fusion.weighting: is \"half\", must be one of \"all-or-nothing\", \"graded\"",
        ),
        (
            "samples-per-period = 5",
            "fusion.samples-per-period: is given, must not be given unless motion = \"samples\"",
        ),
        (
            "modes = 5",
            "fusion.modes: is given, must not be given unless motion = \"modes\"",
        ),
        (
            "motion = \"samples\"\nfeedback = \"none\"",
            "fusion.feedback: is \"none\", must not be \"none\" with motion",
        ),
        (
            "feedback = \"reset\"",
            "fusion.feedback: is \"reset\", must be given together with motion = \"modes\"",
        ),
        (
            "rule = \"published\"\nsharing-factor = 2",
            "fusion.sharing-factor: is given, must not be given together with rule",
        ),
        ("sharing-factor = 0.5", "fusion.sharing-factor: is 0.5"),
        ("motion = \"all\"", "fusion.motion: is \"all\""),
        ("screening = 1.5", "fusion.screening: is 1.5"),
    ] {
        let error = with(fusion)
            .err()
            .unwrap_or_else(|| panic!("accepted: {fusion}"));
        assert!(error.contains(expected), "{fusion}: {error}");
    }
}
