//! Tests of the Jacobian against differences, of published frequencies, and of equivalent
//! structures.

use super::*;
use crate::linear_system::LinearSystem;
use crate::modes::Modes;
use proptest::prelude::*;
use std::f64::consts::PI;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Relative tolerance between an analytic derivative and a central difference, which loses half of
/// the digits.
const DERIVATIVE_TOLERANCE: f64 = 1e-6;

fn parse(text: &str) -> Structure {
    parse_at(text, Path::new("tower.toml"))
}

fn parse_at(text: &str, path: &Path) -> Structure {
    Structure::parse(text, path).unwrap_or_else(|error| panic!("{error}"))
}

/// Returns all kinds of channels, with degrees of freedom by number.
///
/// Every model with at least three degrees of freedom can have them.
fn channels() -> String {
    channels_of(&CHANNELS)
}

/// Quantity, position and unit; hysteretic models have the first four.
const CHANNELS: [(&str, &str, &str); 6] = [
    ("absolute-acceleration", "dof = 1", "m/s2"),
    ("relative-acceleration", "dof = 2", "m/s2"),
    ("restoring-acceleration", "dof = 3", "m/s2"),
    ("velocity", "dof = 1", "m/s"),
    ("displacement", "dof = 3", "m"),
    ("strain", "dofs = [1, 3]\ncoefficients = [-0.5, 0.25]", "1"),
];

fn channels_of(rows: &[(&str, &str, &str)]) -> String {
    let mut text = String::from("[[node]]\nname = \"node\"\n");
    for (quantity, place, unit) in rows {
        let channel = "[[node.channel]]";
        writeln!(
            text,
            "{channel}\nname = \"{quantity}\"\nquantity = \"{quantity}\"\n{place}\n\
             unit = \"{unit}\"\nnoise-std = 1"
        )
        .unwrap();
    }
    text
}

const EXCITATIONS: &str = r#"
[[excitation]]
name = "ground"
kind = "ground"
influence = [1, 1, 0.5]
std = 1

[[excitation]]
name = "push"
kind = "force"
dof = 1
std = 1

[[excitation]]
name = "pull"
kind = "force"
dof = 2
std = 1
"#;

/// Returns three storeys with every kind of parameter; no parameter scales some storeys and masses.
fn shear_building() -> Structure {
    parse(&format!(
        r#"
        [structure]
        name = "tower"
        sampling-rate-hz = 100
        [model]
        kind = "shear-building"
        masses-kg = [2, 1.5, 1]
        stiffnesses-n-per-m = [900, 700, 500]
        [damping]
        kind = "rayleigh"
        alpha-per-s = 0.3
        beta-s = 0.004
        [[parameter]]
        name = "low"
        scales = "stiffness"
        of = ["storey-1", "storey-2"]
        [[parameter]]
        name = "mass"
        scales = "mass"
        of = ["floor-1", "floor-3"]
        [[parameter]]
        name = "alpha"
        scales = "damping-alpha"
        [[parameter]]
        name = "beta"
        scales = "damping-beta"
        {EXCITATIONS}{}"#,
        channels()
    ))
}

const CONSISTENT_MASS: &str = "%%MatrixMarket matrix coordinate real symmetric\n3 3 5\n1 1 2\n\
                               2 1 0.3\n2 2 1.5\n3 2 -0.2\n3 3 1\n";
const LOW: &str =
    "%%MatrixMarket matrix coordinate real symmetric\n3 3 3\n1 1 1600\n2 1 -700\n2 2 700\n";
const HIGH: &str =
    "%%MatrixMarket matrix coordinate real symmetric\n3 3 3\n2 2 500\n3 2 -500\n3 3 500\n";
const DAMPING: &str =
    "%%MatrixMarket matrix coordinate real symmetric\n3 3 4\n1 1 5\n3 1 -2\n2 2 4\n3 3 6\n";

/// Returns a structure with three degrees of freedom from files, with a full mass matrix and the
/// given damping.
fn of_matrices(mass: &str, damping: &str) -> Structure {
    let folder = tempfile::tempdir().unwrap();
    for (name, content) in [
        ("m.mtx", mass),
        ("low.mtx", LOW),
        ("high.mtx", HIGH),
        ("c.mtx", DAMPING),
    ] {
        std::fs::write(folder.path().join(name), content).unwrap();
    }
    let text = format!(
        r#"
        [structure]
        name = "tower"
        sampling-rate-hz = 100
        [model]
        kind = "matrices"
        mass = "m.mtx"
        substructures = {{ low = "low.mtx", high = "high.mtx" }}
        [damping]
        {damping}
        [[parameter]]
        name = "low"
        scales = "stiffness"
        of = ["low"]
        {EXCITATIONS}{}"#,
        channels()
    );
    let path: PathBuf = folder.path().join("tower.toml");
    parse_at(&text, &path)
}

/// Returns three hysteretic springs with every kind of parameter and the given drive.
fn bouc_wen(drive: &str) -> Structure {
    parse(&format!(
        r#"
        [structure]
        name = "chain"
        sampling-rate-hz = 100
        [model]
        kind = "bouc-wen"
        masses-kg = [2, 1.5, 1]
        stiffnesses-n-per-m = [900, 700, 500]
        a = 1.4
        mu = 5
        kappa = 2
        eta = 1.5
        drive = "{drive}"
        [damping]
        kind = "rayleigh"
        alpha-per-s = 0.3
        beta-s = 0.004
        [[parameter]]
        name = "low"
        scales = "stiffness"
        of = ["storey-1", "storey-2"]
        [[parameter]]
        name = "mass"
        scales = "mass"
        of = ["floor-3"]
        [[parameter]]
        name = "beta"
        scales = "damping-beta"
        [[parameter]]
        name = "a"
        scales = "hysteresis-a"
        [[parameter]]
        name = "mu"
        scales = "hysteresis-mu"
        [[parameter]]
        name = "kappa"
        scales = "hysteresis-kappa"
        [[parameter]]
        name = "eta"
        scales = "hysteresis-eta"
        {EXCITATIONS}{}"#,
        channels_of(&CHANNELS[..4])
    ))
}

/// Returns the three storeys with dashpots, two of them scaled.
fn dashpots() -> Structure {
    let text = shear_building().text().to_owned();
    let (from, to) = (
        text.find("[damping]").unwrap(),
        text.find("[[parameter]]").unwrap(),
    );
    let (alpha, excitation) = (
        text.find("[[parameter]]\n        name = \"alpha\"")
            .unwrap(),
        "\n[[excitation]]",
    );
    let dashpots = "[damping]\nkind = \"dashpots\"\ncoefficients-n-s-per-m = [4, 3, 2]\n";
    let scaled = "[[parameter]]\nname = \"dashpots\"\nscales = \"damping\"\n\
                  of = [\"storey-1\", \"storey-3\"]\n";
    let rest = text.find(excitation).unwrap();
    parse(&format!(
        "{}{dashpots}{}{scaled}{}",
        &text[..from],
        &text[to..alpha],
        &text[rest..]
    ))
}

/// Returns a mesh with one free node of three degrees of freedom.
///
/// The node is the end of an inclined beam, or the common end of bars.
fn of_members(model: &str) -> Structure {
    parse(&format!(
        r#"
        [structure]
        name = "members"
        sampling-rate-hz = 100
        [damping]
        kind = "rayleigh"
        alpha-per-s = 0.3
        beta-s = 0.004
        [[parameter]]
        name = "first"
        scales = "stiffness"
        of = ["first"]
        [[parameter]]
        name = "beta"
        scales = "damping-beta"
        [model]
        section = [{{ name = "steel", area-m2 = 1e-4, modulus-pa = 1e8, density-kg-per-m3 = 8000, {model}
        {EXCITATIONS}{}"#,
        channels()
    ))
}

const BEAM: &str = r#"second-moment-m4 = 1e-5 }]
kind = "frame"
nodes = { 1 = [0, 0], 2 = [1, 2] }
group = [{ name = "first", section = "steel", paths = [[1, 2]] }]
support = [{ nodes = [1], fixed = ["x", "y", "r"] }]
"#;

const TRIPOD: &str = r#"}]
kind = "truss"
nodes = { 1 = [0, 0, 0], 2 = [1, 0, 2], 3 = [-1, 1, 2], 4 = [0, -1, 2] }
group = [{ name = "first", section = "steel", paths = [[1, 2], [1, 3]] }, { name = "second", section = "steel", paths = [[1, 4]] }]
support = [{ nodes = [2, 3, 4], fixed = ["x", "y", "z"] }]
"#;

const WHOLE_DAMPING: &str =
    "[[parameter]]\nname = \"damping\"\nscales = \"damping\"\nof = \"all\"\n";

/// Returns the building with one factor for both parts of its damping.
fn with_whole_damping(structure: &Structure) -> Structure {
    let text = structure.text();
    let (start, end) = (
        text.find("[[parameter]]\n        name = \"alpha\"")
            .unwrap(),
        text.find("[[excitation]]").unwrap(),
    );
    parse(&format!(
        "{}{WHOLE_DAMPING}{}",
        &text[..start],
        &text[end..]
    ))
}

fn examples() -> Vec<(&'static str, Structure)> {
    let rayleigh = "kind = \"rayleigh\"\nalpha-per-s = 0.3\nbeta-s = 0.004";
    let given = "kind = \"matrix\"\nfile = \"c.mtx\"";
    let lumped = "%%MatrixMarket matrix coordinate real symmetric\n3 3 3\n1 1 2\n2 2 1.5\n3 3 1\n";
    vec![
        ("shear building", shear_building()),
        (
            "shear building, all its damping",
            with_whole_damping(&shear_building()),
        ),
        (
            "consistent mass, all its damping",
            of_matrices(CONSISTENT_MASS, &format!("{rayleigh}\n{WHOLE_DAMPING}")),
        ),
        (
            "damping matrix as a whole",
            of_matrices(lumped, &format!("{given}\n{WHOLE_DAMPING}")),
        ),
        (
            "consistent mass, Rayleigh damping",
            of_matrices(CONSISTENT_MASS, rayleigh),
        ),
        (
            "consistent mass, damping matrix",
            of_matrices(CONSISTENT_MASS, given),
        ),
        ("lumped mass, damping matrix", of_matrices(lumped, given)),
        ("frame", of_members(BEAM)),
        ("truss", of_members(TRIPOD)),
        ("dashpots", dashpots()),
        ("hysteresis, driven by floors", bouc_wen("floor")),
        ("hysteresis, driven by drifts", bouc_wen("drift")),
    ]
}

/// Returns a state with displacements, velocities, and parameters off their nominal values.
fn state_of(model: &StructureModel) -> Vec<f64> {
    let physical = model.state_len() - model.parameter_len();
    let entry = |i: usize| {
        if i < physical {
            0.1 * (1.3 * i as f64 + 0.4).sin()
        } else {
            0.8 + 0.1 * (i - physical) as f64
        }
    };
    (0..model.state_len()).map(entry).collect()
}

const EXCITATION: [f64; 3] = [0.7, -3.0, 2.0];

/// Returns central differences of `function` of the state, one column per entry.
fn differences(
    state: &[f64],
    rows: usize,
    mut function: impl FnMut(&[f64]) -> Vec<f64>,
) -> DMatrix<f64> {
    const STEP: f64 = 1e-6;
    let mut out = DMatrix::zeros(rows, state.len());
    for column in 0..state.len() {
        let mut moved = |by: f64| {
            let mut state = state.to_vec();
            state[column] += by;
            function(&state)
        };
        let (up, down) = (moved(STEP), moved(-STEP));
        for row in 0..rows {
            out[(row, column)] = (up[row] - down[row]) / (2.0 * STEP);
        }
    }
    out
}

#[track_caller]
fn assert_close(what: &str, found: &DMatrix<f64>, expected: &DMatrix<f64>, tolerance: f64) {
    let difference = (found - expected).norm();
    assert!(
        difference <= tolerance * expected.norm(),
        "{what}: off by {difference:e} of {:e}\nfound{found}expected{expected}",
        expected.norm()
    );
}

#[test]
fn the_process_jacobian_is_the_derivative_of_the_process() {
    for (what, structure) in examples() {
        let mut model = structure.model();
        let (state, len) = (state_of(&model), model.state_len());
        let expected = differences(&state, len, |state| {
            model.linearise_process(state, &EXCITATION);
            let mut out = vec![f64::NAN; len];
            model.derivative(&mut out);
            out
        });
        model.linearise_process(&state, &EXCITATION);
        let mut found = DMatrix::from_element(len, len, f64::NAN);
        model.jacobian_mul(&DMatrix::identity(len, len), &mut found);
        assert_close(what, &found, &expected, DERIVATIVE_TOLERANCE);
    }
}

#[test]
fn the_observation_jacobian_is_the_derivative_of_the_observation() {
    for (what, structure) in examples() {
        let mut model = structure.model();
        let (state, len, rows) = (state_of(&model), model.state_len(), model.observation_len());
        let expected = differences(&state, rows, |state| {
            model.linearise_observation(state, &EXCITATION);
            let mut out = vec![f64::NAN; rows];
            model.observe(&mut out);
            out
        });
        model.linearise_observation(&state, &EXCITATION);
        let mut found = DMatrix::from_element(rows, len, f64::NAN);
        model.observation_jacobian_mul(&DMatrix::identity(len, len), &mut found);
        for row in 0..rows {
            let [found, expected] = [&found, &expected].map(|m| m.rows(row, 1).into_owned());
            assert_close(
                &format!("{what}, row {row}"),
                &found,
                &expected,
                DERIVATIVE_TOLERANCE,
            );
        }
    }
}

/// Both are linear in the excitation, so a difference of any size is exact.
#[test]
fn excitation_matrix_and_feedthrough_are_the_effect_of_the_excitation() {
    for (what, structure) in examples() {
        let mut model = structure.model();
        let (state, len, rows) = (state_of(&model), model.state_len(), model.observation_len());
        let mut effect = |excitation: &[f64]| {
            model.linearise_process(&state, excitation);
            model.linearise_observation(&state, excitation);
            let mut out = vec![0.0; len + rows];
            let (process, observation) = out.split_at_mut(len);
            model.derivative(process);
            model.observe(observation);
            out
        };
        let none = effect(&[0.0; 3]);
        let mut expected = DMatrix::zeros(len + rows, 3);
        for input in 0..3 {
            let mut unit = [0.0; 3];
            unit[input] = 1.0;
            for (row, value) in effect(&unit).iter().enumerate() {
                expected[(row, input)] = value - none[row];
            }
        }
        let mut b = DMatrix::zeros(len, 3);
        model.excitation_matrix(&mut b);
        assert_close(what, &b, &expected.rows(0, len).into_owned(), 1e-12);
        let d = model
            .feedthrough()
            .expect("relative accelerations and forces have a direct term");
        assert_close(what, d, &expected.rows(len, rows).into_owned(), 1e-12);
    }
}

/// The absolute acceleration is the relative acceleration ẍ plus the ground acceleration at that
/// degree of freedom.
#[test]
fn absolute_is_relative_acceleration_plus_the_motion_of_the_ground() {
    let structure = shear_building();
    let mut model = structure.model();
    let state = state_of(&model);
    model.linearise_process(&state, &EXCITATION);
    model.linearise_observation(&state, &EXCITATION);
    let mut rate = vec![0.0; model.state_len()];
    model.derivative(&mut rate);
    let mut seen = vec![0.0; model.observation_len()];
    model.observe(&mut seen);
    assert!(
        (seen[0] - (rate[3] + EXCITATION[0])).abs() < 1e-12,
        "absolute, degree of freedom 1, ι = 1"
    );
    assert!(
        (seen[1] - rate[4]).abs() < 1e-12,
        "relative, degree of freedom 2"
    );
    // No force acts on degree of freedom 3, so its restoring and absolute accelerations are equal;
    // ι = 0.5.
    assert!(
        (seen[2] - (rate[5] + 0.5 * EXCITATION[0])).abs() < 1e-12,
        "restoring, degree of freedom 3"
    );
}

#[test]
fn ground_motion_alone_has_no_direct_effect_on_absolute_accelerations() {
    let text = include_str!("../../../../docs/examples/demo.toml");
    assert!(parse(text).model().feedthrough().is_none());
}

#[test]
fn matrices_of_a_shear_building_give_the_same_model() {
    // Storeys of 900, 700, 500 N/m: LOW contains the first two, HIGH the third.
    let lumped = "%%MatrixMarket matrix coordinate real symmetric\n3 3 3\n1 1 2\n2 2 1.5\n3 3 1\n";
    let dense = lumped.replace("3 3 3\n", "3 3 4\n") + "2 1 0\n";
    let rayleigh = "kind = \"rayleigh\"\nalpha-per-s = 0.3\nbeta-s = 0.004";
    let of_file = of_matrices(&dense, rayleigh);
    let storeys = parse(&{
        let mut text = shear_building().text().to_owned();
        let (from, to) = (
            text.find("[[parameter]]\n        name = \"mass\"").unwrap(),
            text.find("\n[[excitation]]").unwrap(),
        );
        text.replace_range(from..to, "");
        text
    });
    let matrices = |structure: &Structure| {
        let mut model = structure.model();
        let (state, len) = (state_of(&model), model.state_len());
        model.linearise_process(&state, &EXCITATION);
        model.linearise_observation(&state, &EXCITATION);
        let mut a = DMatrix::zeros(len, len);
        model.jacobian_mul(&DMatrix::identity(len, len), &mut a);
        let mut h = DMatrix::zeros(model.observation_len(), len);
        model.observation_jacobian_mul(&DMatrix::identity(len, len), &mut h);
        (a, h)
    };
    let (found, expected) = (matrices(&of_file), matrices(&storeys));
    assert_close("A", &found.0, &expected.0, 1e-14);
    assert_close("H", &found.1, &expected.1, 1e-14);
}

/// Huang & Yuen (2023), §2.3.3: sixty storeys, k/m = 1632 s⁻²; printed f₁ = 0.1669 Hz and damping
/// ratios of 1.0 % in modes 1 and 2.
#[test]
fn the_published_sixty_storey_building_has_its_frequencies_and_damping() {
    let structure = parse(
        r#"
        [structure]
        name = "building"
        sampling-rate-hz = 200
        [model]
        kind = "shear-building"
        storeys = 60
        mass-kg = 1
        stiffness-n-per-m = 1632
        [damping]
        kind = "rayleigh"
        alpha-per-s = 0.0157
        beta-s = 0.0048
        [[parameter]]
        name = "beta"
        scales = "damping-beta"
        [[excitation]]
        name = "ground"
        kind = "ground"
        spectral-intensity = 1.6e-5
        [[node]]
        name = "roof"
        [[node.channel]]
        name = "roof"
        quantity = "absolute-acceleration"
        dof = 60
        unit = "m/s2"
        noise-std = 0.01
        "#,
    );
    let modes = &structure.modes;
    let frequencies: Vec<f64> = modes
        .angular_frequencies
        .iter()
        .map(|omega| omega / (2.0 * PI))
        .collect();
    let ratios = modes.damping_ratios(&structure.system);
    assert!((frequencies[0] - 0.1669).abs() < 5e-5, "{}", frequencies[0]);
    assert!((frequencies[1] - 0.5007).abs() < 5e-5, "{}", frequencies[1]);
    // β is printed with two figures, which leaves an uncertainty of 1 % in the damping.
    assert!((ratios[0] - 0.0100).abs() < 1e-4, "{}", ratios[0]);
    assert!((ratios[1] - 0.0101).abs() < 1e-4, "{}", ratios[1]);
    // Standard deviation of a sample √(2π S₀/Δt), printed as 0.1418 m/s².
    assert!((structure.excitations()[0].std() - 0.1418).abs() < 5e-5);
}

/// Huang & Yuen (2023), chapter 3: five masses of 1 kg, springs of 5000 N/m, f₁ = 3.203 Hz, damping
/// ratios of 1.00 % in modes 1 and 2.
#[test]
fn the_published_chain_has_its_frequency() {
    let stiffness = crate::shear_building::ShearBuilding {
        masses_kg: vec![1.0; 5],
        stiffnesses_n_per_m: vec![5000.0; 5],
    };
    let system = LinearSystem {
        mass: stiffness.mass(),
        substructures: stiffness
            .substructures(&crate::shear_building::with_single_storeys(Vec::new(), 5)),
        damping: Damping::Rayleigh {
            alpha_per_s: 0.2998,
            beta_s: 2.536e-4,
        },
        degrees_of_freedom: stiffness.degrees_of_freedom(),
        ground_directions: Vec::new(),
        storeys: Vec::new(),
        hysteresis: None,
        skeleton: None,
    };
    let modes = Modes::new(system.mass.to_dense(), system.nominal_stiffness()).unwrap();
    assert!((modes.angular_frequencies[0] / (2.0 * PI) - 3.203).abs() < 0.001);
    let ratios = modes.damping_ratios(&system);
    assert!(
        (ratios[0] - 0.01).abs() < 1e-4 && (ratios[1] - 0.01).abs() < 1e-4,
        "{ratios:?}"
    );
}

#[test]
fn uniform_building_has_the_requested_frequency_and_damping() {
    let demo = parse(include_str!("../../../../docs/examples/demo.toml"));
    let modes = &demo.modes;
    assert!((modes.angular_frequencies[0] / (2.0 * PI) - 1.0).abs() < 1e-12);
    let ratios = modes.damping_ratios(&demo.system);
    assert!(
        (ratios[0] - 0.02).abs() < 1e-12 && (ratios[1] - 0.02).abs() < 1e-12,
        "{ratios:?}"
    );
}

/// Returns the natural frequencies (Hz) and damping ratios of an example file as designed.
fn modes_of(text: &str) -> (Vec<f64>, Vec<f64>) {
    let structure = parse(text);
    let modes = &structure.modes;
    let frequencies = modes
        .angular_frequencies
        .iter()
        .map(|omega| omega / (2.0 * PI))
        .collect();
    (frequencies, modes.damping_ratios(&structure.system))
}

/// Huang & Yuen (2023), §2.4.6 and §5.6.2: small motions of both chains, damping ratios of 1 % and
/// 2 % in modes 1 and 2. The second chain has a period of 0.494 s.
#[test]
fn the_published_hysteretic_chains_have_their_frequencies_and_damping() {
    let (frequencies, ratios) =
        modes_of(include_str!("../../../../docs/examples/bouc-wen-ten.toml"));
    assert!(
        (frequencies[0] - 1.0638).abs() < 1e-4 && (frequencies[1] - 3.1676).abs() < 1e-4,
        "{frequencies:?}"
    );
    assert!(
        (ratios[0] - 0.01).abs() < 1e-5 && (ratios[1] - 0.01).abs() < 1e-5,
        "{ratios:?}"
    );
    let (frequencies, ratios) =
        modes_of(include_str!("../../../../docs/examples/bouc-wen-five.toml"));
    assert!(
        (1.0 / frequencies[0] - 0.494).abs() < 5e-4,
        "{frequencies:?}"
    );
    assert!(
        (ratios[0] - 0.02).abs() < 1e-4 && (ratios[1] - 0.02).abs() < 1e-4,
        "{ratios:?}"
    );
}

/// `a` multiplies the stiffness for small motions, and so changes the frequencies: θ₁/m = 6 s⁻² for
/// the oscillator.
#[test]
fn the_oscillator_has_the_frequency_of_its_initial_slope() {
    let (frequencies, _) = modes_of(include_str!(
        "../../../../docs/examples/hysteretic-oscillator.toml"
    ));
    assert!(
        (frequencies[0] - 6.0_f64.sqrt() / (2.0 * PI)).abs() < 1e-12,
        "{frequencies:?}"
    );
}

/// Huang & Yuen (2023), §5.6.1: `ω_j = 80 sin((2j − 1) π / 202)`, damping ratios of 1 % in modes 1
/// and 2.
#[test]
fn the_published_fifty_storey_building_has_its_frequencies_and_damping() {
    let (frequencies, ratios) = modes_of(include_str!("../../../../docs/examples/high-rise.toml"));
    assert_eq!(frequencies.len(), 50);
    for (mode, found) in frequencies.iter().enumerate() {
        let expected = 80.0 * ((2 * mode + 1) as f64 * PI / 202.0).sin() / (2.0 * PI);
        assert!(
            (found / expected - 1.0).abs() < 1e-10,
            "mode {}: {found} instead of {expected}",
            mode + 1
        );
    }
    // α and β are printed with two figures and one figure, which leaves some uncertainty in the
    // damping.
    assert!(
        (ratios[0] - 0.01).abs() < 2e-4 && (ratios[1] - 0.01).abs() < 2e-4,
        "{ratios:?}"
    );
}

/// First natural frequencies of a cantilever of Euler-Bernoulli beams, `(β L)² √(EI / m L⁴) / 2π`,
/// βL = 1.8751, 4.6941. Three elements reproduce the second within 1 %.
#[test]
fn the_mast_of_the_example_is_a_cantilever() {
    let mast = Structure::read(Path::new("../../docs/examples/matrices.toml")).unwrap();
    let modes = &mast.modes;
    let scale = (2.0e8_f64 / (1200.0 * 12.0_f64.powi(4))).sqrt() / (2.0 * PI);
    let found = [0, 1].map(|mode| modes.angular_frequencies[mode] / (2.0 * PI));
    assert!(
        (found[0] / (1.8751_f64.powi(2) * scale) - 1.0).abs() < 1e-3,
        "{found:?}"
    );
    assert!(
        (found[1] / (4.6941_f64.powi(2) * scale) - 1.0).abs() < 1e-2,
        "{found:?}"
    );
}

proptest! {
    /// The bound holds for any parameters within their bounds.
    #[test]
    fn no_rate_exceeds_the_bound(
        factors in proptest::collection::vec(0.05f64..20.0, 7),
        moved in proptest::collection::vec(-1.0f64..1.0, 6),
    ) {
        for (what, structure) in examples() {
            let mut model = structure.model();
            let (len, parameters) = (model.state_len(), model.parameter_len());
            let mut state = vec![0.0; len];
            state[..6].copy_from_slice(&moved);
            state[len - parameters..].copy_from_slice(&factors[..parameters]);
            model.linearise_process(&state, &[0.0; 3]);
            let mut a = DMatrix::zeros(len, len);
            model.jacobian_mul(&DMatrix::identity(len, len), &mut a);
            let fastest = a.complex_eigenvalues().iter().map(|s| s.norm()).fold(0.0, f64::max);
            let bound = model.rate_bound();
            prop_assert!(fastest <= bound * (1.0 + 1e-9), "{}: {} above {}", what, fastest, bound);
        }
    }

    /// Several columns at once give bit-identical results to one column at a time. Six columns
    /// exceed one block.
    #[test]
    fn columns_are_independent_of_each_other(values in proptest::collection::vec(-1.0f64..1.0, 6 * 13)) {
        for (what, structure) in examples() {
            let mut model = structure.model();
            let len = model.state_len();
            model.linearise_process(&state_of(&model), &EXCITATION);
            let columns = DMatrix::from_column_slice(len, 6, &values[..6 * len]);
            let mut together = DMatrix::zeros(len, 6);
            model.jacobian_mul(&columns, &mut together);
            for column in 0..6 {
                let mut alone = DMatrix::zeros(len, 1);
                model.jacobian_mul(&columns.columns(column, 1).into_owned(), &mut alone);
                prop_assert_eq!(alone.column(0), together.column(column), "{}", what);
            }
        }
    }
}

/// A factor on all damping equals a factor on its coefficients, for Rayleigh damping, dashpots and
/// a given matrix.
#[test]
fn a_factor_on_all_damping_is_one_on_its_coefficients() {
    let whole = with_whole_damping(&shear_building());
    let doubled = parse(
        &whole
            .text()
            .replace("alpha-per-s = 0.3", "alpha-per-s = 0.6")
            .replace("beta-s = 0.004", "beta-s = 0.008"),
    );
    let [by_factor, by_file] = [(&whole, 2.0), (&doubled, 1.0)].map(|(structure, factor)| {
        LinearForm::new(&mut structure.model(), &[1.0, 1.0, factor]).system
    });
    assert!((by_factor - &by_file).norm() <= 1e-14 * by_file.norm());
}
