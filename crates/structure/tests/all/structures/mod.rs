//! Structures of every kind for tests of whole runs.

use spandrel_structure::Structure;
use std::fmt::Write;
use std::path::Path;

/// Reads an example of the book.
pub fn example(name: &str) -> Structure {
    parse(name, &text_of(name))
}

/// Returns the text of an example of the book.
pub fn text_of(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name)
        .with_extension("toml");
    std::fs::read_to_string(path).unwrap()
}

/// Reads a structure from its text, as a file in the folder of the examples.
pub fn parse(name: &str, text: &str) -> Structure {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name)
        .with_extension("toml");
    Structure::parse(text, &path).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// Returns a portal of three beams with consistent or lumped mass, under an unmeasured sideways
/// excitation.
pub fn portal(mass: &str) -> Structure {
    let text = format!(
        r#"
        [structure]
        name = "portal"
        sampling-rate-hz = 200
        [model]
        kind = "frame"
        mass = "{mass}"
        [model.nodes]
        1 = [0, 0]
        2 = [0, 4]
        3 = [6, 4]
        4 = [6, 0]
        [[model.section]]
        name = "beam"
        area-m2 = 0.01
        second-moment-m4 = 1e-4
        modulus-pa = 1e8
        density-kg-per-m3 = 7850
        [[model.group]]
        name = "columns"
        section = "beam"
        paths = [[1, 2], [3, 4]]
        [[model.group]]
        name = "roof"
        section = "beam"
        paths = [[2, 3]]
        [[model.support]]
        nodes = [1, 4]
        fixed = ["x", "y", "r"]
        "#
    );
    parse(
        "demo",
        &(text
            + &sway(
                "columns",
                "roof",
                "node-2-x",
                "node-3-x",
                "direction = \"x\"",
            )),
    )
}

/// Returns a plane mast of four bars on two supports, with lumped or consistent mass.
pub fn small_truss(mass: &str) -> Structure {
    let text = format!(
        r#"
        [structure]
        name = "truss"
        sampling-rate-hz = 200
        [model]
        kind = "truss"
        mass = "{mass}"
        [model.nodes]
        1 = [0, 0]
        2 = [3, 0]
        3 = [0, 3]
        4 = [3, 3]
        [[model.section]]
        name = "bar"
        area-m2 = 1e-4
        modulus-pa = 2e9
        density-kg-per-m3 = 7860
        [[model.group]]
        name = "low"
        section = "bar"
        paths = [[1, 3], [2, 3], [2, 4]]
        [[model.group]]
        name = "high"
        section = "bar"
        paths = [[3, 4], [1, 4]]
        [[model.support]]
        nodes = [1, 2]
        fixed = ["x", "y"]
        "#
    );
    parse(
        "demo",
        &(text + &sway("low", "high", "node-3-x", "node-4-y", "direction = \"x\"")),
    )
}

/// Returns damping, two parameters, an unmeasured ground motion and two accelerometers.
fn sway(first: &str, second: &str, one: &str, other: &str, direction: &str) -> String {
    let mut text = format!(
        r#"
        [damping]
        kind = "rayleigh"
        ratio = 0.02
        modes = [1, 2]
        [filter]
        half-life-s = 5
        [[excitation]]
        name = "ground"
        kind = "ground"
        {direction}
        std = 0.5
        [[node]]
        name = "node"
        "#
    );
    for dof in [one, other] {
        let channel = "[[node.channel]]\nquantity = \"absolute-acceleration\"\nunit = \"m/s2\"\n\
                       noise-std = 0.05";
        writeln!(text, "{channel}\nname = \"{dof}\"\ndof = \"{dof}\"").unwrap();
    }
    for group in [first, second] {
        writeln!(
            text,
            "[[parameter]]\nname = \"{group}\"\nscales = \"stiffness\"\n\
                        of = [\"{group}\"]\nstd = 0.1"
        )
        .unwrap();
    }
    text
}

/// Returns the tower with 12 beams instead of 37.
pub fn small_tower() -> Structure {
    let mut text = text_of("tower")
        .replace("elements = 27", "elements = 8")
        .replace("elements = 10", "elements = 4");
    for (node, nearest) in [
        (4, 1),
        (8, 2),
        (13, 4),
        (18, 5),
        (23, 7),
        (27, 8),
        (32, 10),
        (37, 12),
    ] {
        text = text.replace(&format!("\"node-{node}-"), &format!("\"node-{nearest}-"));
    }
    parse("tower", &text)
}

/// Returns the tower with four beams, at its own sampling rate.
pub fn smallest_tower() -> Structure {
    let mut text = text_of("tower")
        .replace("elements = 27", "elements = 2")
        .replace("elements = 10", "elements = 2");
    for (node, nearest) in [
        (4, 1),
        (8, 1),
        (13, 1),
        (18, 2),
        (23, 2),
        (27, 2),
        (32, 3),
        (37, 4),
    ] {
        text = text.replace(&format!("\"node-{node}-"), &format!("\"node-{nearest}-"));
    }
    parse("tower", &text)
}

/// Returns eight unequal storeys with parameters of every kind.
///
/// A measured force and an unmeasured ground motion excite them. The ground motion affects the
/// sensors directly. The force is linear from frame to frame.
pub fn building_with_masses() -> Structure {
    let mut text = String::from(
        r#"
        [structure]
        name = "masses"
        sampling-rate-hz = 100
        [model]
        kind = "shear-building"
        masses-kg = [2, 1.5, 1, 1, 1.2, 0.9, 1, 0.8]
        stiffnesses-n-per-m = [2900, 2700, 2500, 2500, 2400, 2300, 2200, 2100]
        [damping]
        kind = "rayleigh"
        alpha-per-s = 0.3
        beta-s = 0.002
        [filter]
        half-life-s = 10
        input-hold = "first-order"
        "#,
    );
    let parameters = [
        ("low", "stiffness", "[\"storey-1\", \"storey-2\"]"),
        ("high", "stiffness", "[\"storey-8\"]"),
        ("mass", "mass", "[\"floor-1\", \"floor-3\"]"),
        ("top", "mass", "[\"floor-8\"]"),
    ];
    for (name, scales, of) in parameters {
        writeln!(
            text,
            "[[parameter]]\nname = \"{name}\"\nscales = \"{scales}\"\nof = {of}"
        )
        .unwrap();
    }
    for name in ["alpha", "beta"] {
        writeln!(
            text,
            "[[parameter]]\nname = \"{name}\"\nscales = \"damping-{name}\""
        )
        .unwrap();
    }
    text.push_str(
        r#"
        [[excitation]]
        name = "ground"
        kind = "ground"
        std = 1
        [[excitation]]
        name = "push"
        kind = "force"
        dof = 2
        std = 1
        measured-on = "push"
        [[node]]
        name = "node"
        [[node.channel]]
        name = "push"
        quantity = "force"
        unit = "N"
        noise-std = 0.01
        "#,
    );
    for dof in [1, 4, 8] {
        let channel = "[[node.channel]]\nquantity = \"relative-acceleration\"\nunit = \"m/s2\"\n\
                       noise-std = 0.05";
        writeln!(text, "{channel}\nname = \"floor-{dof}\"\ndof = {dof}").unwrap();
    }
    parse("demo", &text)
}
