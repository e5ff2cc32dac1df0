//! Structure files as text.

use std::path::{Path, PathBuf};

/// A house whose two channels belong to one node `shake`, at 100 Hz.
pub const HOUSE: &str = r#"
[structure]
name = "house"
sampling-rate-hz = 100
[model]
kind = "shear-building"
storeys = 1
mass-kg = 20_000
first-frequency-hz = 2.0
[damping]
kind = "rayleigh"
ratio = 0.02
[[parameter]]
name = "storey-1"
scales = "stiffness"
of = ["storey-1"]
[[excitation]]
name = "ground"
kind = "ground"
std = 0.1
measured-on = "ground"
[[node]]
name = "shake"
[[node.channel]]
name = "ground"
quantity = "ground-acceleration"
unit = "m/s2"
noise-std = 0.005
range = 1e9
[[node.channel]]
name = "roof"
quantity = "absolute-acceleration"
dof = "floor-1"
unit = "m/s2"
noise-std = 0.005
range = 1e9
"#;

/// Returns the path of the demo's structure file.
pub fn five_storeys() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml")
}

/// Returns a building of two storeys at 100 Hz with nodes `ground` (1 channel), `floor-1` (1) and
/// `roof` (2), followed by `more`.
///
/// By default, live nodes have a practically unlimited lateness, so that a slow machine does not
/// change any number.
pub fn two_storeys(more: &str) -> String {
    let lateness = if more.contains("[ingest]") {
        ""
    } else {
        "[ingest]\nlateness-s = 3600\n"
    };
    let roof_velocity = "[[node.channel]]\nname = \"roof-velocity\"\nquantity = \"velocity\"\n\
                         dof = \"floor-2\"\n\
                         unit = \"m/s\"\nnoise-std = 0.001\n";
    let roof = accelerometer("roof", "floor-2") + roof_velocity;
    shaken_storeys(2) + &accelerometer("floor-1", "floor-1") + &roof + lateness + more
}

/// Returns a building of `count` storeys at 100 Hz with an accelerometer per floor, followed by
/// `more`.
pub fn storeys(count: u32, more: &str) -> String {
    let floors = (1..=count)
        .map(|number| format!("floor-{number}"))
        .map(|floor| accelerometer(&floor, &floor));
    shaken_storeys(count) + &floors.collect::<String>() + more
}

/// Returns a building of four storeys in which each floor identifies its own parameters, fused at
/// this rate (Hz). The stiffness is 10 % above the start value of the filters.
pub fn distributed_storeys(fusions_hz: f64) -> String {
    let mut text = "[structure]\nname = \"house\"\nsampling-rate-hz = 50\n\
                    identification = \"distributed\"\n\
         [model]\nkind = \"shear-building\"\nstoreys = 4\nmass-kg = 20_000\n\
         first-frequency-hz = 1.0\n\
         [damping]\nkind = \"rayleigh\"\nratio = 0.02\n\
         [[excitation]]\nname = \"ground\"\nkind = \"ground\"\nstd = 0.5\n"
        .to_owned();
    for storey in 1..=4 {
        text += &format!(
            "[[parameter]]\nname = \"storey-{storey}\"\nscales = \"stiffness\"\n\
             of = [\"storey-{storey}\"]\nmean = 0.9\nstd = 0.1\n\
             [[node]]\nname = \"floor-{storey}\"\n\
             [[node.channel]]\nname = \"displacement-{storey}\"\nquantity = \"displacement\"\n\
             dof = \"floor-{storey}\"\n\
             unit = \"m\"\nnoise-std = 2e-4\n\
             [[node.channel]]\nname = \"acceleration-{storey}\"\n\
             quantity = \"absolute-acceleration\"\ndof = \"floor-{storey}\"\n\
             unit = \"m/s2\"\nnoise-std = 0.01\n"
        );
    }
    let fusion = format!("[fusion]\nrate-hz = {fusions_hz}\n");
    text + "[filter]\nhalf-life-s = 60\nannealing-amount = 0\n"
        + &fusion
        + "[simulation]\nseed = 1\n"
}

/// Returns equal storeys of uncertain stiffness, and the node `ground`.
fn shaken_storeys(count: u32) -> String {
    let parameters = (1..=count).map(|number| {
        format!(
            "[[parameter]]\nname = \"storey-{number}\"\nscales = \"stiffness\"\n\
                 of = [\"storey-{number}\"]\n"
        )
    });
    let model = format!(
        "[structure]\nname = \"house\"\nsampling-rate-hz = 100\n\
         [model]\nkind = \"shear-building\"\nstoreys = {count}\nmass-kg = 20_000\n\
         first-frequency-hz = 2.0\n\
         [damping]\nkind = \"rayleigh\"\nratio = 0.02\n"
    );
    let ground = "[[excitation]]\nname = \"ground\"\nkind = \"ground\"\nstd = 0.1\n\
                  measured-on = \"ground\"\n\
                  [[node]]\nname = \"ground\"\n[[node.channel]]\nname = \"ground\"\n\
                  quantity = \"ground-acceleration\"\nunit = \"m/s2\"\nnoise-std = 0.005\n";
    model + &parameters.collect::<String>() + ground
}

/// Returns a node with an accelerometer of the same name.
fn accelerometer(name: &str, dof: &str) -> String {
    format!(
        "[[node]]\nname = \"{name}\"\n[[node.channel]]\nname = \"{name}\"\n\
         quantity = \"absolute-acceleration\"\ndof = \"{dof}\"\nunit = \"m/s2\"\n\
         noise-std = 0.005\n\
         noise-group = \"floors\"\nadapt-noise = true\n"
    )
}
