use crate::{DeclaredMode, Structure, StructureError};
use std::path::Path;

const DEMO: &str = include_str!("../../../../../docs/examples/demo.toml");
const MODAL: &str = r#"
[modal]
epoch-s = 300
band-hz = [0.5, 12]
without = ["floor-2"]

[[modal.mode]]
name = "bending-1"
frequency-hz = 1.0

[[modal.mode]]
name = "bending-2"
frequency-hz = 2.92
within = 0.03
"#;

fn parse(modal: &str) -> Result<Structure, StructureError> {
    Structure::parse(&format!("{DEMO}{modal}"), Path::new("demo.toml"))
}

/// Returns the mistakes after a change, without the path and the number of lines of the demo.
fn mistakes(from: &str, to: &str) -> String {
    assert!(MODAL.contains(from), "{from}");
    let error = parse(&MODAL.replacen(from, to, 1)).unwrap_err();
    let StructureError::Invalid { diagnostics } = error else {
        panic!("{error}");
    };
    let before = DEMO.lines().count();
    let lines = diagnostics.iter().map(|diagnostic| {
        let text = diagnostic.to_string();
        let (line, rest) = text
            .strip_prefix("demo.toml:")
            .unwrap()
            .split_once(':')
            .unwrap();
        format!("{}:{rest}", line.parse::<usize>().unwrap() - before)
    });
    lines.collect::<Vec<_>>().join("\n")
}

#[test]
fn responses_without_those_left_out_are_followed() {
    let structure = parse(MODAL).unwrap();
    let plan = structure.modal().unwrap();
    assert_eq!(plan.names, ["floor-1", "floor-3", "floor-4", "floor-5"]);
    let all: Vec<&str> = structure.channels().map(|channel| channel.name()).collect();
    let named: Vec<&str> = plan
        .channels
        .iter()
        .map(|position| all[*position])
        .collect();
    assert_eq!(named, plan.names, "the ground is an excitation");
    let settings = &plan.settings;
    assert_eq!((settings.lowest_hz, settings.highest_hz), (0.5, 12.0));
    assert_eq!((settings.epoch_s, settings.overlap), (300.0, 0.0));
    assert_eq!(settings.references.len(), 4);
    assert_eq!(plan.stream().unwrap().settings().count(), 1);
    let expected = [("bending-1", 1.0, 0.05), ("bending-2", 2.92, 0.03)];
    let expected = expected.map(|(name, frequency_hz, within)| DeclaredMode {
        name: name.to_owned(),
        frequency_hz,
        within,
    });
    assert_eq!(plan.modes, expected);
}

#[test]
fn an_empty_table_uses_all_responses_and_several_bands() {
    let structure = parse("\n[modal]\n").unwrap();
    let plan = structure.modal().unwrap();
    assert_eq!(plan.names.len(), 5);
    assert_eq!(plan.settings.epoch_s, 600.0);
    assert!(plan.stream().unwrap().settings().count() > 1);
    assert!(plan.modes.is_empty());
    assert!(parse("").unwrap().modal().is_none());
}

/// Declaring a mode must not restart the identification.
#[test]
fn the_basis_of_the_identification_does_not_contain_the_table() {
    let basis = |modal| parse(modal).unwrap().identification_basis();
    assert_eq!(basis(MODAL), basis(""));
}

#[test]
fn every_mistake_names_line_key_and_allowed_values() {
    for (from, to, said) in [
        (
            "epoch-s = 300",
            "epoch-s = 5",
            "3: modal.epoch-s: is 5, must be a whole number from 10 to 86400",
        ),
        (
            "epoch-s = 300",
            "epoch-s = 30",
            "3: modal.epoch-s: is 30, must be at least 72 with these channels, band and sampling \
             rate",
        ),
        (
            "epoch-s = 300",
            "epochs = 300",
            "3: modal.epochs: is not a known key, did you mean \"epoch-s\"?",
        ),
        (
            "epoch-s = 300",
            "overlap = 1",
            "3: modal.overlap: is 1, must be a finite number from 0 and below 1",
        ),
        (
            "epoch-s = 300",
            "highest-order = 1",
            "3: modal.highest-order: is 1, must be a whole number from 2 to 200",
        ),
        (
            "epoch-s = 300",
            "references = [\"floor-2\"]",
            "3: modal.references: is \"floor-2\", ",
        ),
        (
            "[0.5, 12]",
            "[12, 0.5]",
            "4: modal.band-hz: is [12.0, 0.5], must be two increasing frequencies, such as [0.5, \
             12]",
        ),
        (
            "[0.5, 12]",
            "[0.5, 45]",
            "4: modal.band-hz: is too wide, must end at most at 40 Hz, 0.4 of the sampling rate",
        ),
        (
            "[\"floor-2\"]",
            "[\"floor-7\"]",
            "5: modal.without: is \"floor-7\", ",
        ),
        (
            "[\"floor-2\"]",
            "[\"floor-1\", \"floor-2\", \"floor-3\", \"floor-4\"]",
            "5: modal.without: leaves 1 channel that measure responses at the sampling rate of the \
             structure, must leave 2 to 128",
        ),
        (
            "name = \"bending-2\"",
            "name = \"bending-1\"",
            "12: modal.mode.name: repeats \"bending-1\", must be unique",
        ),
        (
            "frequency-hz = 2.92",
            "frequency-hz = 29.2",
            "13: modal.mode.frequency-hz: is 29.2, must be within the band, 0.5 to 12 Hz",
        ),
        (
            "within = 0.03",
            "within = 3",
            "14: modal.mode.within: is 3, must be a finite number above 0 and below 1",
        ),
    ] {
        let found = mistakes(from, to);
        assert!(found.contains(said), "{to}: {found}");
    }
}

const SENSORS_ONLY: &str = include_str!("../../../../../docs/examples/modes/sensors-only.toml");

fn sensors_only(from: &str, to: &str) -> Result<Structure, StructureError> {
    assert!(SENSORS_ONLY.contains(from), "{from}");
    let text = SENSORS_ONLY.replacen(from, to, 1);
    Structure::parse(&text, Path::new("sensors-only.toml"))
}

#[test]
fn sensors_alone_are_a_structure_without_a_model() {
    let structure = sensors_only("", "").unwrap();
    assert!(!structure.has_model() && parse("").unwrap().has_model());
    assert!(structure.parameters().is_empty() && structure.noise_levels().is_empty());
    assert!(structure.natural_frequencies_hz().is_empty());
    assert_eq!(structure.modal().unwrap().names.len(), 5);
    let drawing = structure.drawing();
    let heights: Vec<f64> = drawing
        .sensors
        .iter()
        .map(|sensor| drawing.points[sensor.point.unwrap()].y)
        .collect();
    assert_eq!(heights, [3.0, 6.0, 9.0, 12.0, 15.0]);
    assert_eq!(drawing.members.len(), 5);
    assert!(drawing.members.iter().all(|member| member.parts.is_empty()));
}

/// The smallest file: names of sensors, and no table `[modal]`.
#[test]
fn names_of_sensors_are_enough() {
    let text = "[structure]\nname = \"bridge\"\nsampling-rate-hz = 50\n\
         [model]\nkind = \"modal\"\n\
         [[node]]\nname = \"deck\"\n\
         [[node.channel]]\nname = \"left\"\nquantity = \"velocity\"\nunit = \"m/s\"\n\
         [[node.channel]]\nname = \"right\"\nquantity = \"velocity\"\nunit = \"m/s\"\n";
    let bridge = Structure::parse(text, Path::new("bridge.toml")).unwrap();
    let plan = bridge.modal().unwrap();
    assert_eq!((plan.names.len(), plan.settings.epoch_s), (2, 600.0));
    assert!(bridge.drawing().points.is_empty());
    let one = text.split("[[node.channel]]\nname = \"right\"").next();
    let told = Structure::parse(one.unwrap(), Path::new("bridge.toml")).unwrap_err();
    let told = told.to_string();
    assert!(
        told.starts_with("bridge.toml:4: modal.without: leaves 1"),
        "{told}"
    );
}

#[test]
fn what_needs_a_model_is_refused_at_its_line() {
    let no_model = "must not be given with kind = \"modal\", which has no model to identify";
    let node = "[[node]]";
    for (from, to, line, said) in [
        (
            node,
            "[[parameter]]\nname = \"all\"\n\n[[node]]",
            17,
            format!("parameter: is given, {no_model}"),
        ),
        (
            node,
            "[damping]\nratio = 0.02\n\n[[node]]",
            17,
            format!("damping: is given, {no_model}"),
        ),
        (
            node,
            "[[alert]]\nloss = 0.1\n\n[[node]]",
            17,
            format!("alert: is given, {no_model}"),
        ),
        (
            "at = \"floor-1\"",
            "noise-std = 0.1",
            24,
            format!("node.channel.noise-std: is given, {no_model}"),
        ),
        (
            "at = \"floor-1\"",
            "dof = \"floor-1\"",
            24,
            format!("node.channel.dof: is given, {no_model}"),
        ),
        (
            "at = \"floor-1\"",
            "at = \"floor-7\"",
            24,
            "node.channel.at: is \"floor-7\", must be one of ground, floor-1, ".to_owned(),
        ),
        (
            "direction = \"x\"",
            "direction = \"up\"",
            25,
            "node.channel.direction: is \"up\", must be one of \"x\", \"y\", \"z\"".to_owned(),
        ),
        (
            "floor-5 = [0, 15]",
            "floor-5 = [0, 15, 0]",
            14,
            "model.nodes.floor-5: has 3 coordinates, must have 2 like the previous nodes"
                .to_owned(),
        ),
        (
            "floor-5 = [0, 15] }",
            "floor-4 = [0, 15] }",
            15,
            "model.paths: ends in node floor-5, which has no coordinates, ".to_owned(),
        ),
        (
            "sampling-rate-hz = 100",
            "sampling-rate-hz = 100\nidentification = \"distributed\"",
            9,
            "structure.identification: is \"distributed\", must not be".to_owned(),
        ),
    ] {
        let told = sensors_only(from, to).unwrap_err().to_string();
        let expected = format!("sensors-only.toml:{line}: {said}");
        assert!(
            told.contains(&expected),
            "{to}: {told}\nexpected: {expected}"
        );
    }
}

#[test]
fn command_that_needs_a_model_names_the_line_of_the_kind() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bridge.toml");
    std::fs::write(&path, SENSORS_ONLY).unwrap();
    assert!(Structure::read(&path).is_ok());
    let told = Structure::read_with_model(&path).unwrap_err().to_string();
    let expected = ":13: model.kind: is \"modal\", must be a kind with masses and stiffnesses: \
                    this command needs a model";
    assert!(told.ends_with(expected), "{told}");
    std::fs::write(&path, DEMO).unwrap();
    assert!(Structure::read_with_model(&path).is_ok());
}

#[test]
fn modes_update_the_stiffness_parameters_if_the_file_asks_for_it() {
    let plan = |to: &str| {
        let text = MODAL.replacen("[modal]\n", &format!("[modal]\n{to}"), 1);
        parse(&text).unwrap().modal().unwrap().update.clone()
    };
    assert_eq!(plan(""), None);
    assert_eq!(plan("updates = \"none\"\n"), None);
    let update = plan("updates = \"stiffness\"\n").unwrap();
    assert!(update.parts.contains(&"storey-2".to_owned()), "{update:?}");
    assert_eq!(update.parts.len(), update.settings.prior_std.len());
    assert_eq!(update.settings.commissioning_epochs, 144);
    let updated = format!(
        "{DEMO}{}",
        MODAL.replacen("[modal]\n", "[modal]\nupdates = \"stiffness\"\n", 1)
    );
    let updated = Structure::parse(&updated, Path::new("demo.toml")).unwrap();
    assert!(updated.has_model() && !updated.is_filtered());
    assert!(parse(MODAL).unwrap().is_filtered());
}

#[test]
fn an_update_without_anything_to_update_is_refused() {
    let mistake = |text: &str| {
        let error = Structure::parse(text, Path::new("x.toml")).unwrap_err();
        let StructureError::Invalid { diagnostics } = error else {
            panic!("{error}");
        };
        diagnostics
            .iter()
            .map(ToString::to_string)
            .collect::<String>()
    };
    let updates = "updates = \"stiffness\"\n";
    let sensors = SENSORS_ONLY.replacen("[modal]\n", &format!("[modal]\n{updates}"), 1);
    let told = mistake(&sensors);
    assert!(
        told.ends_with("must be \"none\" without a model of linear springs"),
        "{told}"
    );
    let told = mistake(&format!("{DEMO}\n[modal]\n{updates}"));
    assert!(
        told.ends_with("must be \"none\" without a [[modal.mode]]"),
        "{told}"
    );
    let told = mistake(&format!("{DEMO}\n[modal]\nupdates = \"mass\"\n"));
    assert!(
        told.contains("modal.updates: is \"mass\", must be "),
        "{told}"
    );
}
