//! Tests of valid files, and of mistakes with line, key and text.

use crate::{Diagnostic, Reference, Structure, StructureError};
use std::path::{Path, PathBuf};

pub(super) const DEMO: &str = include_str!("../../../../docs/examples/demo.toml");

fn examples() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/examples"))
}

/// Reads a text as a file in the folder of the examples.
pub(super) fn read(text: &str) -> Result<Structure, StructureError> {
    Structure::parse(text, &examples().join("tower.toml"))
}

/// Reads `DEMO` with every occurrence of a piece replaced; returns its mistakes as
/// `key: found, allowed`.
#[track_caller]
fn mistakes_after(replaced: &str, by: &str) -> Vec<String> {
    assert!(DEMO.contains(replaced), "the example has no {replaced:?}");
    mistakes(&DEMO.replacen(replaced, by, 1))
}

#[track_caller]
pub(super) fn mistakes(text: &str) -> Vec<String> {
    let error = read(text).expect_err("the file should be refused");
    error
        .diagnostics()
        .iter()
        .map(|d| format!("{}: {}, {}", d.key(), d.found(), d.allowed()))
        .collect()
}

/// Returns the line (from 1) of the first occurrence of `piece`.
#[track_caller]
pub(super) fn line_of(text: &str, piece: &str) -> usize {
    text.lines()
        .position(|line| line.contains(piece))
        .expect("the piece should be there")
        + 1
}

/// Returns the structure files with a model in a folder and its subfolders.
fn structure_files(folder: &Path) -> Vec<PathBuf> {
    let (folders, files): (Vec<_>, Vec<_>) = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .partition(|path| path.is_dir());
    files
        .into_iter()
        .filter(|file| {
            file.extension()
                .is_some_and(|extension| extension == "toml")
        })
        .filter(|file| std::fs::read_to_string(file).unwrap().contains("[model]"))
        .chain(folders.iter().flat_map(|folder| structure_files(folder)))
        .collect()
}

#[test]
fn every_example_is_read() {
    let files = structure_files(examples());
    assert!(files.len() > 30, "{files:?}");
    for file in files {
        if let Err(error) = Structure::read(&file) {
            panic!("{error}");
        }
    }
}

#[test]
fn demo_has_the_values_of_its_file() {
    let demo = read(DEMO).unwrap();
    assert_eq!(
        (demo.name(), demo.sampling_rate_hz(), demo.display_rate_hz()),
        ("demo", 100.0, 10.0)
    );
    let nodes: Vec<&str> = demo.nodes().iter().map(crate::Node::name).collect();
    assert_eq!(
        nodes,
        [
            "ground", "floor-1", "floor-2", "floor-3", "floor-4", "floor-5"
        ]
    );
    assert_eq!(demo.channel_count(), 6);
    assert_eq!(demo.excitation_channels(), [Some(0)]);
    assert_eq!(demo.observation_channels(), [1, 2, 3, 4, 5]);
    let parameters: Vec<_> = demo
        .parameters()
        .iter()
        .map(|p| (p.name(), p.mean(), p.std()))
        .collect();
    assert_eq!(parameters[1], ("storey-2", 1.0, 0.2));
    let levels: Vec<_> = demo
        .noise_levels()
        .iter()
        .map(|l| (l.name(), l.std(), l.is_adapted()))
        .collect();
    assert_eq!(levels, [("ground", 0.005, false), ("floors", 0.005, true)]);
    let [rule] = demo.alert_rules() else {
        panic!("one rule")
    };
    assert_eq!(rule.parameters, [0, 1, 2, 3, 4]);
    assert_eq!(
        (rule.loss, rule.credibility, rule.sustain_s),
        (0.05, 0.99, 5.0)
    );
    assert_eq!(rule.reference, Reference::Baseline { learn_s: 30.0 });
    assert_eq!(demo.text(), DEMO);
}

#[test]
fn a_record_map_turns_units_into_si() {
    let noisy = Structure::read(&examples().join("noisy.toml")).unwrap();
    let columns: Vec<_> = noisy
        .record()
        .columns()
        .iter()
        .map(|c| (c.column(), c.factor()))
        .collect();
    assert_eq!(columns[0], ("base", 9.80665));
    assert_eq!(columns[1], ("floor-1", 1.0));
    assert_eq!(columns[5], ("roof", -0.01));
}

#[test]
fn record_map_converts_times_and_rates() {
    let plain = read(DEMO).unwrap();
    let record = plain.record();
    assert_eq!(
        (record.time_column(), record.time_unit(), record.resamples()),
        ("time", "s", false)
    );
    assert!(record.columns().iter().all(|column| !column.states_unit()));
    let text = format!(
        "{DEMO}\n[record]\ntime-column = \"\"\ntime-unit = \"us\"\nresample = true\n\
         columns.floor-1.unit = \"g\"\n"
    );
    let declared = read(&text).unwrap();
    let record = declared.record();
    assert_eq!(
        (record.time_column(), record.time_unit(), record.resamples()),
        ("", "us", true)
    );
    let stated: Vec<_> = record
        .columns()
        .iter()
        .filter(|c| c.states_unit())
        .map(|c| c.column())
        .collect();
    assert_eq!(stated, ["floor-1"]);
    let wrong = format!("{DEMO}\n[record]\ntime-unit = \"h\"\n");
    let told = read(&wrong).unwrap_err().to_string();
    assert!(told.contains("record.time-unit: is \"h\""), "{told}");
}

/// The channels of a node can fail together, unless it is the only node.
#[test]
fn channels_of_one_node_are_one_sensor_unless_it_is_the_only_node() {
    let sensors = |change: &dyn Fn(&str) -> String| {
        let structure = Structure::parse(&change(DEMO), Path::new("demo.toml")).unwrap();
        structure.filter_settings().unwrap().sensors
    };
    assert_eq!(sensors(&str::to_owned), [0, 1, 2, 3, 4]);
    let without = |text: &str, floor: usize| {
        text.replace(&format!("[[node]]\nname = \"floor-{floor}\"\n"), "")
    };
    assert_eq!(sensors(&|text| without(text, 3)), [0, 1, 1, 2, 3]);
    let together = |text: &str| (1..=5).fold(text.to_owned(), |text, floor| without(&text, floor));
    assert_eq!(sensors(&together), [0, 1, 2, 3, 4]);
}

#[test]
fn filter_settings_are_in_steps_and_variances() {
    let settings = read(DEMO).unwrap().filter_settings().unwrap();
    // Half-life 10 s at 100 Hz: λ = 2^(2/1000).
    assert!((settings.fading.value() - 2f64.powf(0.002)).abs() < 1e-15);
    assert_eq!(settings.prior_std.as_slice()[0], 1e-5);
    assert_eq!(settings.prior_std.as_slice()[5], 1e-4);
    assert_eq!(
        settings.prior_std.as_slice()[10..],
        [0.2, 0.2, 0.2, 0.2, 0.2, 0.5]
    );
    assert_eq!(settings.noise.excitation[(0, 0)], 0.005 * 0.005);
    assert_eq!(settings.noise.sensors.norm(), 0.0, "adapted, so not known");
    assert_eq!(settings.noise.parameters.len(), 1);
    assert_eq!(
        settings.noise.parameters[0].pattern,
        nalgebra::DMatrix::identity(5, 5)
    );
    // Ten periods of 1 s. The frequency is solved for, so rounding can remove one step.
    assert!((999..=1000).contains(&settings.noise_settings.training_steps));
}

#[test]
fn error_has_file_line_key_found_and_allowed_values() {
    let text = DEMO.replace("loss = 0.05", "loss = 1.5");
    let line = line_of(&text, "loss = 1.5");
    let path = examples().join("tower.toml");
    let expected = format!(
        "{}:{line}: alert.loss: is 1.5, must be a finite number above 0 and below 1",
        path.display()
    );
    assert_eq!(read(&text).unwrap_err().to_string(), expected);
}

#[test]
fn all_mistakes_are_reported_at_once_in_the_order_of_the_file() {
    let text = DEMO
        .replace("sampling-rate-hz = 100", "sampling-rate-hz = -100")
        .replace("mass-kg = 20_000", "mass-kg = nan")
        .replacen("of = [\"storey-3\"]", "of = [\"storey-33\"]", 1)
        .replacen("unit = \"m/s2\"", "unit = \"g\"", 1)
        .replace("half-life-s = 10", "half-live-s = 10")
        .replace("at-s = 60", "at-s = \"a minute\"");
    let error = read(&text).unwrap_err();
    let keys: Vec<&str> = error.diagnostics().iter().map(Diagnostic::key).collect();
    // The substructures are unknown as long as the model has a mistake, so storey-33 is not
    // reported.
    let expected = [
        "structure.sampling-rate-hz",
        "model.mass-kg",
        "node.channel.unit",
        "filter.half-live-s",
        "simulation.damage.at-s",
    ];
    assert_eq!(keys, expected);
    let lines: Vec<usize> = error.diagnostics().iter().map(Diagnostic::line).collect();
    assert_eq!(lines[3], line_of(&text, "half-live-s"));
    assert!(lines.is_sorted());
}

#[test]
fn unknown_key_gives_a_suggestion() {
    assert_eq!(
        mistakes_after("half-life-s = 10", "half-live-s = 10"),
        ["filter.half-live-s: is not a known key, did you mean \"half-life-s\"?"]
    );
    assert_eq!(
        mistakes_after("[filter]", "[filters]"),
        ["filters: is not a known key, did you mean \"filter\"?"]
    );
}

#[test]
fn a_unit_other_than_si_is_refused() {
    assert_eq!(
        mistakes_after("unit = \"m/s2\"", "unit = \"g\""),
        ["node.channel.unit: is \"g\", must be \"m/s2\", the SI unit of ground-acceleration"]
    );
}

#[test]
fn numbers_out_of_range_or_not_finite_are_refused() {
    assert_eq!(
        mistakes_after("mass-kg = 20_000", "mass-kg = -20_000"),
        ["model.mass-kg: is -20000, must be a finite number above 0"]
    );
    assert_eq!(
        mistakes_after("ratio = 0.02", "ratio = nan"),
        ["damping.ratio: is nan, must be a finite number above 0 and below 1"]
    );
    assert_eq!(
        mistakes_after("noise-std = 0.005", "noise-std = inf"),
        ["node.channel.noise-std: is inf, must be a finite number from 1e-30 and up to 1e30"]
    );
}

#[test]
fn numbers_whose_frequencies_overflow_are_refused() {
    assert_eq!(
        mistakes_after("first-frequency-hz = 1.0", "first-frequency-hz = 1e200"),
        [
            "model.kind: has no natural frequencies, must have masses and stiffnesses of real \
             structures"
        ]
    );
}

#[test]
fn a_value_of_the_wrong_type_is_refused() {
    assert_eq!(
        mistakes_after("sampling-rate-hz = 100", "sampling-rate-hz = \"fast\""),
        [
            "structure.sampling-rate-hz: is \"fast\", must be a finite number from 0.001 and up \
             to 20000"
        ]
    );
    assert_eq!(
        mistakes_after("storeys = 5", "storeys = 5.5"),
        ["model.storeys: is 5.5, must be a whole number from 1 to 1000"]
    );
    assert_eq!(
        mistakes_after("adapt-noise = true", "adapt-noise = 1")[0],
        "node.channel.adapt-noise: is 1, must be true or false"
    );
    assert_eq!(
        mistakes_after("of = [\"storey-1\"]", "of = \"storey-1\""),
        ["parameter.of: is \"storey-1\", must be a list of names"]
    );
}

#[test]
fn missing_keys_are_reported_at_their_table() {
    let text = DEMO
        .replacen("scales = \"stiffness\"\n", "", 1)
        .replace("loss = 0.05\n", "");
    let error = read(&text).unwrap_err();
    let found: Vec<_> = error
        .diagnostics()
        .iter()
        .map(|d| (d.key(), d.found(), d.line()))
        .collect();
    let expected = [
        (
            "parameter.scales",
            "is missing",
            line_of(&text, "[[parameter]]"),
        ),
        ("alert.loss", "is missing", line_of(&text, "[[alert]]")),
    ];
    assert_eq!(found, expected);
}

#[test]
fn missing_tables_are_reported() {
    let keys: Vec<String> = mistakes("")
        .into_iter()
        .map(|m| m.split(':').next().unwrap().to_owned())
        .collect();
    assert_eq!(
        keys,
        ["structure", "model", "damping", "node", "excitation"]
    );
}

#[test]
fn parameter_without_a_known_substructure_is_rejected() {
    assert_eq!(
        mistakes_after("of = [\"storey-3\"]", "of = [\"storey-33\"]"),
        [
            "parameter.of: is \"storey-33\", must be one of storey-1, storey-2, storey-3, \
             storey-4, storey-5"
        ]
    );
    assert_eq!(
        mistakes_after("of = [\"storey-3\"]", "of = []"),
        ["parameter.of: scales nothing, must list the substructures whose stiffness is scaled"]
    );
}

#[test]
fn a_parameter_without_effect_is_refused() {
    let text = DEMO
        .replace("ratio = 0.02\nmodes = [1, 2]", "alpha-per-s = 0.1")
        .replace(
            "[[excitation]]",
            "[[parameter]]\nname = \"beta\"\nscales = \"damping-beta\"\n\n[[excitation]]",
        );
    assert_eq!(
        mistakes(&text),
        [
            "parameter.scales: has no effect: there is no beta, must scale a damping coefficient \
             of [damping] that is not zero"
        ]
    );
}

#[test]
fn substructure_scaled_twice_is_rejected() {
    assert_eq!(
        mistakes_after("of = [\"storey-2\"]", "of = [\"storey-1\", \"storey-2\"]"),
        [
            "parameter.of: scales storey-1 as parameter \"storey-1\" does, must scale what no \
             other parameter scales"
        ]
    );
}

#[test]
fn repeated_names_are_rejected() {
    assert_eq!(
        mistakes_after("name = \"storey-2\"", "name = \"storey-1\"")[0],
        "parameter.name: repeats \"storey-1\", must be unique"
    );
    assert_eq!(
        mistakes_after(
            "[[node]]\nname = \"floor-2\"",
            "[[node]]\nname = \"floor-1\""
        ),
        ["node.name: repeats \"floor-1\", must be unique"]
    );
    assert_eq!(
        mistakes_after(
            "[[node.channel]]\nname = \"floor-2\"",
            "[[node.channel]]\nname = \"floor-1\""
        ),
        ["node.channel.name: repeats \"floor-1\", must be unique"]
    );
}

#[test]
fn name_with_invalid_characters_is_rejected() {
    assert_eq!(
        mistakes_after("name = \"demo\"", "name = \"Demo/Tower\""),
        [
            "structure.name: is \"Demo/Tower\", must be a name of 1 to 64 lower-case letters, \
             digits and hyphens"
        ]
    );
}

#[test]
fn unused_ground_channel_is_rejected() {
    assert_eq!(
        mistakes_after("measured-on = \"ground\"\n", ""),
        [
            "node.channel.name: is \"ground\", which measures ground-acceleration for no \
             excitation, must be named by measured-on of an [[excitation]]"
        ]
    );
    assert_eq!(
        mistakes_after("measured-on = \"ground\"\n", "measured-on = \"floor-1\"\n")[0],
        "excitation.measured-on: is \"floor-1\", a channel of absolute-acceleration, must be a \
         channel of ground-acceleration: ground"
    );
    assert_eq!(
        mistakes_after("measured-on = \"ground\"\n", "measured-on = \"grund\"\n")[0],
        "excitation.measured-on: is \"grund\", must be a channel of ground-acceleration: ground"
    );
}

#[test]
fn sensors_of_one_noise_group_must_have_the_same_noise() {
    let second = DEMO.find("name = \"floor-2\"\nquantity").unwrap();
    let (head, tail) = DEMO.split_at(second);
    let text = head.to_owned() + &tail.replacen("noise-std = 0.005", "noise-std = 0.01", 1);
    assert_eq!(
        mistakes(&text),
        [
            "node.channel.noise-std: differs from the others of noise group \"floors\", must be \
             the same within a group"
        ]
    );
}

#[test]
fn an_unknown_degree_of_freedom_is_refused() {
    assert_eq!(
        mistakes_after("dof = \"floor-5\"", "dof = \"flor-5\""),
        ["node.channel.dof: is \"flor-5\", did you mean \"floor-5\"?"]
    );
    assert_eq!(
        mistakes_after("dof = \"floor-5\"", "dof = 6"),
        ["node.channel.dof: is 6, must be from 1 to 5"]
    );
}

#[test]
fn a_band_limit_above_half_the_rate_is_refused() {
    let text = DEMO.replace("[filter]", "[band-limit]\nfrequency-hz = 60\n\n[filter]");
    assert_eq!(
        mistakes(&text),
        ["band-limit.frequency-hz: is 60, must be below half the sampling rate, 50"]
    );
}

#[test]
fn a_node_slower_than_the_structure_must_divide_its_rate() {
    let node = "[[node]]\nname = \"floor-1\"";
    let with_rate = |rate: &str| format!("{node}\nsampling-rate-hz = {rate}");
    assert!(read(&DEMO.replacen(node, &with_rate("50"), 1)).is_ok());
    assert_eq!(
        mistakes_after(node, &with_rate("40")),
        [
            "node.sampling-rate-hz: is 40, must be 100 (the structure's) or that divided by a \
             whole number"
        ]
    );
}

#[test]
fn clocks_of_unknown_nodes_and_absurd_drifts_are_refused() {
    let clocks = "[simulation]\nclock-offsets-s = { floor-9 = 1 }\n\
                  clock-drifts-ppm = { floor-1 = 10_001, floor-2 = -50 }\n";
    let found = mistakes(&DEMO.replacen("[simulation]\n", clocks, 1));
    assert_eq!(found.len(), 2, "{found:?}");
    assert!(
        found[0].starts_with("simulation.clock-offsets-s: is \"floor-9\""),
        "{found:?}"
    );
    assert_eq!(
        found[1],
        "simulation.clock-drifts-ppm.floor-1: is 10001, must be a finite number from -10000 and \
         up to 10000"
    );
}

#[test]
fn damage_beyond_the_whole_stiffness_is_refused() {
    let text = DEMO.to_owned()
        + "\n[[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 90\nloss = 0.9\n";
    assert_eq!(
        mistakes(&text),
        ["simulation.damage.loss: adds up to 1.05 for this parameter, must stay below 1 in all"]
    );
}

#[test]
fn text_that_is_not_toml_is_refused_with_its_line() {
    let error = read("[structure]\nname = \"a\"\nname = \"b\"\nrate = \n").unwrap_err();
    let lines: Vec<usize> = error.diagnostics().iter().map(Diagnostic::line).collect();
    assert_eq!(lines, [3, 4]);
    assert_eq!(error.diagnostics()[0].key(), "syntax");
}

#[test]
fn missing_file_is_not_reported_as_a_mistake_in_the_file() {
    let error = Structure::read(Path::new("/nowhere/tower.toml")).unwrap_err();
    assert!(matches!(error, StructureError::Unreadable { .. }));
    assert_eq!(error.to_string(), "/nowhere/tower.toml: cannot be read");
}

proptest::proptest! {
    #[test]
    fn any_text_gives_a_structure_or_an_error(text in "\\PC*") {
        let _ = read(&text);
    }

    #[test]
    fn file_without_any_one_line_causes_no_panic(line in 0usize..150) {
        let text: Vec<&str> = DEMO.lines().enumerate().filter(|(n, _)| *n != line).map(|(_, l)| l).collect();
        let _ = read(&text.join("\n"));
    }
}

mod matrices {
    use super::*;
    use std::fs;

    const MASS: &str = "%%MatrixMarket matrix coordinate real general\n2 2 2\n1 1 1\n2 2 1\n";
    const LOWER: &str = "%%MatrixMarket matrix coordinate real general\n2 2 1\n1 1 100\n";
    const UPPER: &str =
        "%%MatrixMarket matrix coordinate real general\n2 2 4\n1 1 80\n1 2 -80\n2 1 -80\n2 2 80\n";

    const FILE: &str = r#"
[structure]
name = "two"
sampling-rate-hz = 100

[model]
kind = "matrices"
mass = "m.mtx"
substructures = { lower = "lower.mtx", upper = "upper.mtx" }

[damping]
kind = "rayleigh"
ratio = 0.02

[[parameter]]
name = "lower"
scales = "stiffness"
of = ["lower"]

[[excitation]]
name = "wind"
kind = "force"
dof = 2
spectral-intensity = 5e-5

[[node]]
name = "top"

[[node.channel]]
name = "top"
quantity = "displacement"
dof = 2
unit = "m"
noise-std = 1e-4
"#;

    /// Reads `FILE` in a folder with the given matrices.
    fn read_with(
        text: &str,
        mass: &str,
        lower: &str,
        upper: &str,
    ) -> Result<Structure, StructureError> {
        let folder = tempfile::tempdir().unwrap();
        for (name, content) in [("m.mtx", mass), ("lower.mtx", lower), ("upper.mtx", upper)] {
            fs::write(folder.path().join(name), content).unwrap();
        }
        Structure::parse(text, &folder.path().join("two.toml"))
    }

    #[track_caller]
    fn single_mistake(
        result: Result<Structure, StructureError>,
    ) -> (usize, String, String, String) {
        let error = result.expect_err("should be refused");
        let [d] = error.diagnostics() else {
            panic!("{error}")
        };
        // The folder differs between runs.
        let found = d.found().rsplit('/').next().unwrap().to_owned();
        (d.line(), d.key().to_owned(), found, d.allowed().to_owned())
    }

    #[test]
    fn matrices_are_read_beside_the_file() {
        let structure = read_with(FILE, MASS, LOWER, UPPER).unwrap();
        assert_eq!(structure.system.degrees_of_freedom, ["1", "2"]);
        // σ² = 2π S₀/Δt, chapter 3, A1.
        assert!(
            (structure.excitations()[0].std().powi(2) - std::f64::consts::TAU * 5e-5 * 100.0).abs()
                < 1e-12
        );
    }

    #[test]
    fn line_breaks_of_windows_are_read() {
        let crlf = |text: &str| text.replace('\n', "\r\n");
        assert!(read_with(&crlf(FILE), &crlf(MASS), &crlf(LOWER), &crlf(UPPER)).is_ok());
    }

    #[test]
    fn a_negative_mass_is_refused() {
        let mistake = single_mistake(read_with(
            FILE,
            &MASS.replace("2 2 1\n", "2 2 -1\n"),
            LOWER,
            UPPER,
        ));
        let found = "has the mass -1 kg at degree of freedom 2".to_owned();
        assert_eq!(
            mistake,
            (
                8,
                "model.mass".to_owned(),
                found,
                "must be positive definite".to_owned()
            )
        );
    }

    #[test]
    fn an_indefinite_stiffness_is_refused() {
        let mistake = single_mistake(read_with(FILE, MASS, &LOWER.replace("100", "-100"), UPPER));
        let (line, key, found, allowed) = mistake;
        assert_eq!((line, key.as_str()), (9, "model.substructures.lower"));
        assert_eq!(
            (found.as_str(), allowed.as_str()),
            (
                "has the negative eigenvalue -1.000000e2",
                "must be positive semidefinite"
            )
        );
    }

    #[test]
    fn an_asymmetric_stiffness_is_refused() {
        let (_, key, found, allowed) = single_mistake(read_with(
            FILE,
            MASS,
            LOWER,
            &UPPER.replace("1 2 -80", "1 2 -70"),
        ));
        assert_eq!(key, "model.substructures.upper");
        assert_eq!(
            found,
            "upper.mtx has -70 at row 1, column 2 but -80 at row 2, column 1"
        );
        assert_eq!(allowed, "must be symmetric");
    }

    #[test]
    fn a_structure_that_can_move_freely_is_refused() {
        let (line, key, found, _) =
            single_mistake(read_with(FILE, MASS, LOWER, &UPPER.replace("80", "0")));
        assert_eq!((line, key.as_str()), (6, "model.substructures"));
        assert_eq!(found, "leave degree of freedom 2 free to move");
    }

    #[test]
    fn a_matrix_of_another_size_is_refused() {
        let larger = "%%MatrixMarket matrix coordinate real general\n3 3 1\n1 1 100\n";
        let (_, key, found, allowed) = single_mistake(read_with(FILE, MASS, larger, UPPER));
        assert_eq!(key, "model.substructures.lower");
        assert_eq!(
            (found.as_str(), allowed.as_str()),
            (
                "has 3 degrees of freedom",
                "must have 2 like the mass matrix"
            )
        );
    }

    #[test]
    fn a_matrix_file_that_is_missing_or_broken_is_refused() {
        let text = FILE.replace("m.mtx", "n.mtx");
        let (line, key, found, _) = single_mistake(read_with(&text, MASS, LOWER, UPPER));
        assert_eq!((line, key.as_str()), (8, "model.mass"));
        assert!(found.starts_with("n.mtx cannot be read"), "{found}");
        let (_, key, found, _) = single_mistake(read_with(FILE, MASS, "1 2 3", UPPER));
        assert_eq!(key, "model.substructures.lower");
        assert!(found.starts_with("lower.mtx is not readable"), "{found}");
    }

    #[test]
    fn a_mass_parameter_needs_a_diagonal_mass() {
        let mass =
            "%%MatrixMarket matrix coordinate real symmetric\n2 2 3\n1 1 1\n2 1 0.1\n2 2 1\n";
        let text = FILE.replace(
            "scales = \"stiffness\"\nof = [\"lower\"]",
            "scales = \"mass\"\nof = [\"1\"]",
        );
        assert!(read_with(&text, MASS, LOWER, UPPER).is_ok());
        let (_, key, _, allowed) = single_mistake(read_with(&text, mass, LOWER, UPPER));
        assert_eq!(key, "parameter.scales");
        assert_eq!(
            allowed,
            "must not scale masses unless the mass matrix is diagonal"
        );
    }

    #[test]
    fn an_influence_vector_of_the_wrong_length_is_refused() {
        let text = FILE.replace(
            "kind = \"force\"\ndof = 2",
            "kind = \"ground\"\ninfluence = [1]",
        );
        let (_, key, found, allowed) = single_mistake(read_with(&text, MASS, LOWER, UPPER));
        assert_eq!(key, "excitation.influence");
        assert_eq!(found, "has 1 entry");
        assert_eq!(
            allowed,
            "must have 2, one per degree of freedom, not all zero"
        );
    }

    #[test]
    fn a_matrix_of_absurd_size_is_refused() {
        for size in ["1001", "1000000000000", "99999999999999999999999999"] {
            let lower = LOWER.replace("2 2 1\n", &format!("{size} {size} 1\n"));
            let (_, key, found, allowed) = single_mistake(read_with(FILE, MASS, &lower, UPPER));
            assert_eq!(key, "model.substructures.lower");
            assert!(
                found.starts_with(&format!("lower.mtx has {size} in")),
                "{found}"
            );
            assert_eq!(
                allowed,
                "must have at most 1000 degrees of freedom (reduce the model first)"
            );
        }
    }

    proptest::proptest! {
        #[test]
        fn any_matrix_file_gives_a_structure_or_an_error(
            kind in "(coordinate|array) (real|integer|complex|pattern) \
                     (general|symmetric|skew-symmetric|hermitian)",
            body in "([0-9]{1,30}|-?[0-9]\\.[0-9]e[0-9]{1,3}|NaN|inf|[ \n%])( |\n)([0-9 \n\
                     .e+-]{0,40})",
        ) {
            let _ = read_with(FILE, MASS, &format!("%%MatrixMarket matrix {kind}\n{body}"), UPPER);
            let _ = read_with(FILE, MASS, &format!("%%MatrixMarket matrix {kind}\n2 2 1\n\
                                                    {body}"), UPPER);
        }
    }
}

#[test]
fn numbers_that_would_overflow_or_stall_a_filter_are_refused() {
    for (from, to, key) in [
        (
            "half-life-s = 10",
            "half-life-s = 1e-6",
            "filter.half-life-s: is 0.000001, must be at least 10 time steps, 0.1 s",
        ),
        (
            "noise-std = 0.005",
            "noise-std = 1e200",
            "node.channel.noise-std: is 1e200",
        ),
        (
            "sampling-rate-hz = 100",
            "sampling-rate-hz = 1e9",
            "structure.sampling-rate-hz: is 1e9",
        ),
        (
            "std = 0.2",
            "std = 1e200",
            "parameter.std: is 1e200, must be a finite number from 1e-9 and up to 1e6",
        ),
    ] {
        let mistakes = mistakes_after(from, to);
        assert!(
            mistakes.iter().any(|mistake| mistake.starts_with(key)),
            "{mistakes:?}"
        );
    }
}

#[test]
fn recording_given_as_a_structure_is_one_error() {
    let text = "time,a,b\n".to_owned() + &"0.1,2,3\n".repeat(500);
    let told = |name: &str| {
        Structure::parse(&text, Path::new(name))
            .unwrap_err()
            .to_string()
    };
    assert_eq!(
        told("monday.csv"),
        "monday.csv:1: syntax: is a recording, must be a structure file (TOML)"
    );
    let lines = told("monday.toml").lines().count();
    assert!((2..=31).contains(&lines), "{lines} lines");
}

const GROUND: &str = include_str!("../../../../docs/examples/fifty-storeys.toml");
const WIND: &str = include_str!("../../../../docs/examples/fifty-storeys-wind.toml");

#[test]
fn field_of_forces_equals_the_published_wind() {
    let structure = read(WIND).unwrap();
    assert_eq!(structure.excitations()[0].component_len(), 50);
    assert_eq!(structure.excitation_channels().len(), 50);
    let (mean, pattern) = (structure.mean_excitation(), structure.excitation_pattern(0));
    // Yuen, Liang & Kuok (2013), case 3: 27 718 N at the top; γ² exp(−|h_i − h_j|/H) F_i F_j at a
    // distance of 7.5 m with H = 10 m.
    assert!((mean[49] - 27_718.0).abs() < 0.5, "{}", mean[49]);
    let expected = 0.04 * (-0.75_f64).exp() * mean[10] * mean[13];
    assert!(
        (pattern[(10, 13)] / expected - 1.0).abs() < 1e-12
            && pattern[(13, 10)] == pattern[(10, 13)]
    );
    let settings = structure.filter_settings().unwrap();
    let wind = &settings.noise.parameters[0];
    assert_eq!((wind.name.as_str(), &wind.pattern), ("wind", &pattern));
    assert!((wind.start / 10.0 - 1.0).abs() < 1e-4, "{}", wind.start);
}

#[test]
fn a_structure_under_mean_forces_begins_in_equilibrium() {
    let structure = read(WIND).unwrap();
    // Statically determinate: the shear of the lowest storey is the total wind force; 41.9 mm at
    // the top in the source.
    let prior = structure.filter_settings().unwrap().prior_mean;
    let shear = structure.mean_excitation().sum();
    assert!(
        (prior[0] * 652.9e6 / shear - 1.0).abs() < 1e-9,
        "{}",
        prior[0]
    );
    assert!((prior[49] - 0.0419).abs() < 5e-5, "{}", prior[49]);
    assert_eq!(structure.simulator(1).state(), prior.as_slice());
}

#[test]
fn a_covariance_from_a_file_is_that_of_the_formula() {
    let folder = tempfile::tempdir().unwrap();
    let formula = read(WIND).unwrap().excitation_pattern(0);
    let entries = formula.iter().map(|entry| format!("{entry:?}\n"));
    let text = "%%MatrixMarket matrix array real general\n50 50\n".to_owned()
        + &entries.collect::<String>();
    std::fs::write(folder.path().join("wind.mtx"), text).unwrap();
    let with_file = WIND
        .replace("intensity = 0.2 ", "covariance = \"wind.mtx\" ")
        .replace("correlation-length", "# ");
    let structure = Structure::parse(&with_file, &folder.path().join("wind.toml")).unwrap();
    assert!((structure.excitation_pattern(0) - &formula).amax() <= 1e-12 * formula.amax());
}

#[test]
fn error_names_mistakes_of_a_field_of_forces() {
    let found = |from: &str, to: &str| {
        assert!(WIND.contains(from));
        mistakes(&WIND.replacen(from, to, 1))
    };
    assert_eq!(
        found("dofs = \"all\"", "dofs = \"some\""),
        [
            "excitation.dofs: is \"some\", must be \"all\" or a list of degrees of freedom, each \
             once"
        ]
    );
    assert_eq!(
        found("dofs = \"all\"", "dofs = [1, 2]"),
        ["excitation.mean: has 50 entries, must have 2"]
    );
    assert_eq!(
        found("intensity = 0.2", "std = 1\nintensity = 0.2"),
        [
            "excitation.std: is given together with intensity, must give either std (of one \
             sample of each force, N), intensity (a \
          share of mean) or covariance"
        ]
    );
    assert_eq!(
        found(
            "correlation-length = 4 ",
            "positions = [1, 2]\ncorrelation-length = 4 "
        ),
        ["excitation.positions: has 2 entries, must have 50, one per degree of freedom of dofs"]
    );
    assert_eq!(
        found("level = 3.1623", "measured-on = \"floor-1\""),
        [
            "excitation.measured-on: is not a known key, must be one of name, kind, adapt, \
             level-factor, level, dofs, mean, covariance, std, intensity, correlation-length, \
             positions"
        ]
    );
}

#[test]
fn filter_without_parameters_has_no_fading_and_no_annealing() {
    let structure = read(GROUND).unwrap();
    let settings = structure.filter_settings().unwrap();
    assert_eq!((settings.fading.value(), settings.annealing), (1.0, None));
    assert!((settings.noise_settings.fading - 2f64.powf(0.002)).abs() < 1e-15);
    assert_eq!(
        structure.estimated_responses()[3].terms(),
        [(99, 1.0)],
        "velocity of floor 50"
    );
}

#[test]
fn settings_that_require_a_parameter_are_rejected_without_one() {
    assert_eq!(
        mistakes(&(GROUND.to_owned() + "\n[[alert]]\nparameters = \"all\"\nloss = 0.1\n")),
        ["alert: is given, must not be given without a [[parameter]]: an alert watches parameters"]
    );
    let damage = "\n[[simulation.damage]]\nparameter = \"storey-1\"\nat-s = 1\nloss = 0.1\n";
    assert_eq!(
        mistakes(&(GROUND.to_owned() + damage)),
        ["simulation.damage.parameter: is \"storey-1\", none is declared"]
    );
    assert_eq!(
        mistakes(&GROUND.replace(
            "display-rate-hz",
            "identification = \"distributed\"\ndisplay-rate-hz"
        )),
        [
            "structure.identification: is \"distributed\", must not be distributed without a \
             [[parameter]]: nodes identify and share parameters",
            "structure.identification: is \"distributed\", must not be distributed with \
             [[response]]: a station estimates parameters, not the motion"
        ]
    );
    assert!(
        !mistakes(&(GROUND.to_owned() + "\n[classes]\nkind = \"self-calibrating\"\n")).is_empty()
    );
}

#[test]
fn a_response_is_a_displacement_a_velocity_or_a_strain() {
    let with = |quantity: &str| {
        let response = format!(
            "[[response]]\nname = \"roof\"\nquantity = \"{quantity}\"\ndof = \"floor-5\"\n\n\
             [filter]"
        );
        DEMO.replace("[filter]", &response)
    };
    assert_eq!(
        read(&with("velocity")).unwrap().estimated_responses()[0].terms(),
        [(9, 1.0)]
    );
    assert_eq!(
        mistakes(&with("force")),
        ["response.quantity: is \"force\", must be one \
             of \"displacement\", \"velocity\", \"strain\""]
    );
    let twice = with("displacement").replace("name = \"roof\"", "name = \"storey-1\"");
    assert_eq!(
        mistakes(&twice),
        ["response.name: repeats \"storey-1\", must be unique"]
    );
}

#[test]
fn default_learning_time_is_thirty_periods_or_three_half_lives() {
    let reference = |text: &str| read(text).unwrap().alert_rules()[0].reference.clone();
    let without = DEMO.replace("reference = { learn-s = 30 }", "");
    let Reference::Baseline { learn_s } = reference(&without) else {
        panic!("not learnt")
    };
    assert!(
        (learn_s - 30.0).abs() < 1e-9,
        "30 periods of 1 s: {learn_s}"
    );
    let Reference::Baseline { learn_s } =
        reference(&without.replace("half-life-s = 10", "half-life-s = 20"))
    else {
        panic!("not learnt")
    };
    assert!((learn_s - 60.0).abs() < 1e-9, "three half-lives: {learn_s}");
    let design = DEMO.replace("{ learn-s = 30 }", "{ design-std = 0.05 }");
    assert_eq!(
        reference(&design),
        Reference::Given {
            mean: vec![1.0; 5],
            std: vec![0.05; 5]
        }
    );
}

#[test]
fn error_suggests_a_deviation_for_the_design_reference() {
    let found = |to: &str| mistakes(&DEMO.replace("{ learn-s = 30 }", to));
    assert_eq!(
        found("\"design\""),
        [
            "alert.reference: is \"design\", must state how far the design may be off: { \
             design-std = 0.05 }, or { learn-s = … } to learn the reference"
        ]
    );
    assert_eq!(
        found("{ design-std = 0.05, learn-s = 3 }"),
        [
            "alert.reference.design-std: is given together with learn-s, must be given alone: the \
             mean is that of the design, 1"
        ]
    );
    assert_eq!(found("{ design-std = 0 }").len(), 1);
}

#[test]
fn stiffness_rule_excludes_damping() {
    assert_eq!(
        read(DEMO).unwrap().alert_rules()[0].parameters,
        [0, 1, 2, 3, 4]
    );
    let all = DEMO.replace("parameters = \"stiffness\"", "parameters = \"all\"");
    assert_eq!(
        read(&all).unwrap().alert_rules()[0].parameters,
        [0, 1, 2, 3, 4, 5]
    );
}

#[test]
fn measured_excitation_is_interpolated_and_unmeasured_excitation_is_held() {
    use spandrel_filter::InputHold;
    let hold = |text: &str| read(text).unwrap().filter_settings().unwrap().input_hold;
    assert_eq!(hold(DEMO), InputHold::First);
    assert_eq!(
        hold(&DEMO.replace("half-life-s = 10", "input-hold = \"zero-order\"")),
        InputHold::Zero
    );
    assert_eq!(
        hold(include_str!("../../../../docs/examples/output-only.toml")),
        InputHold::Zero
    );
    let matrices = std::fs::read_to_string(examples().join("matrices.toml")).unwrap();
    let mixed = read(&matrices.replace("input-hold = \"zero-order\"", "#")).unwrap();
    assert_eq!(mixed.input_holds(), [InputHold::First, InputHold::Zero]);
}

#[test]
fn the_level_of_an_unmeasured_excitation_is_identified_unless_it_is_known() {
    let output_only = include_str!("../../../../docs/examples/output-only.toml");
    let ground = |to: &str| {
        let structure = read(&output_only.replace("level-factor = 3 ", to)).unwrap();
        let settings = structure.filter_settings().unwrap();
        let adapted = settings
            .noise
            .parameters
            .iter()
            .find(|level| level.name == "ground");
        adapted.map(|level| level.start_std / level.start)
    };
    // A factor F of the standard deviation is 2 ln F in the logarithm of the variance.
    for (to, factor) in [
        ("#", 3.0_f64),
        ("level-factor = 2 #", 2.0),
        ("adapt = true #", 3.0),
    ] {
        assert!(
            (ground(to).unwrap() - 2.0 * factor.ln()).abs() < 1e-12,
            "{to}"
        );
    }
    assert_eq!(
        (ground("level-factor = 1 #"), ground("adapt = false #")),
        (None, None)
    );
    // The level of a measured excitation is the noise of its channel and is not adapted.
    assert!(!read(DEMO).unwrap().noise_levels()[0].is_adapted());
    assert_eq!(
        mistakes(&output_only.replace("level-factor = 3 ", "adapt = true\nlevel-factor = 1 #"))
            .len(),
        1
    );
    assert_eq!(
        mistakes(&DEMO.replace(
            "measured-on = \"ground\"",
            "measured-on = \"ground\"\nlevel-factor = 2"
        ))
        .len(),
        1
    );
}

const PARTICLES: &str = include_str!("../../../../docs/examples/hysteretic-particles.toml");

#[test]
fn particles_are_read_with_their_keys_and_defaults() {
    let keys = read(PARTICLES).unwrap().particles().unwrap();
    assert_eq!(
        (keys.particles, keys.drift_per_root_s, keys.warm_up_s),
        (500, 0.005, 2.0)
    );
    let text = PARTICLES
        .replace("particles = 500", "drift = 0.02\nwarm-up-s = 0")
        .replace("density = \"prior\"", "");
    let keys = read(&text).unwrap().particles().unwrap();
    assert_eq!(
        (keys.particles, keys.drift_per_root_s, keys.warm_up_s),
        (2000, 0.02, 0.0)
    );
    assert_eq!(read(DEMO).unwrap().particles(), None);
}

#[test]
fn unsupported_settings_of_particles_and_keys_without_particles_are_rejected() {
    for (added, told) in [
        (
            "\n[outliers]\n",
            "outliers: is given, must not be given with filter.kind",
        ),
        (
            "\n[classes]\nkind = \"self-calibrating\"\n",
            "classes: is given, must not be given with filter.kind",
        ),
    ] {
        let found = mistakes(&(PARTICLES.to_owned() + added));
        assert!(
            found.iter().any(|mistake| mistake.contains(told)),
            "{found:?}"
        );
    }
    let distributed = PARTICLES.replace("display-rate-hz = 10", "identification = \"distributed\"");
    let found = mistakes(&distributed);
    assert!(
        found
            .iter()
            .any(|mistake| mistake.contains("nodes exchange Gaussian densities")),
        "{found:?}"
    );
    let found = mistakes(&PARTICLES.replace("kind = \"particle\"", ""));
    let told = |key: &str| {
        format!("filter.{key}: has no effect, must not be given without kind = \"particle\"")
    };
    assert_eq!(found, [told("particles"), told("density")]);
    let found = mistakes(&PARTICLES.replace("particles = 500", "particles = 1"));
    assert_eq!(
        found,
        ["filter.particles: is 1, must be a whole number from 2 to 10000000"]
    );
}
