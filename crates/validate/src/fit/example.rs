//! The example files: the simulated length and the correct verdict of each.

use super::measure;
use crate::cases::Case;
use crate::error::ValidateError;
use spandrel_structure::Structure;
use std::path::{Path, PathBuf};

/// Matrices that the examples refer to, by path relative to the file.
const MATRICES: [(&str, &str); 7] = [
    (
        "k-lower.mtx",
        include_str!("../../../../docs/examples/matrices/k-lower.mtx"),
    ),
    (
        "k-middle.mtx",
        include_str!("../../../../docs/examples/matrices/k-middle.mtx"),
    ),
    (
        "k-upper.mtx",
        include_str!("../../../../docs/examples/matrices/k-upper.mtx"),
    ),
    (
        "mass.mtx",
        include_str!("../../../../docs/examples/matrices/mass.mtx"),
    ),
    (
        "vehicle-along-x.mtx",
        include_str!("../../../../docs/examples/matrices/vehicle-along-x.mtx"),
    ),
    (
        "vehicle-along-y.mtx",
        include_str!("../../../../docs/examples/matrices/vehicle-along-y.mtx"),
    ),
    (
        "vehicle-mass.mtx",
        include_str!("../../../../docs/examples/matrices/vehicle-mass.mtx"),
    ),
];

/// Correct verdict according to the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Right {
    Supported,
    Doubtful,
    /// Nothing judges the fit.
    NoVerdict,
}

impl Right {
    pub(super) fn words(self) -> &'static str {
        match self {
            Self::Supported => "supported",
            Self::Doubtful => "doubtful",
            Self::NoVerdict => "no verdict",
        }
    }
}

/// One example file.
#[derive(Debug)]
pub(super) struct Example {
    pub(super) name: &'static str,
    pub(super) text: &'static str,
    /// Changes the file if a full run would take too long.
    pub(super) shortened: fn(&str) -> String,
    /// Simulated length (s).
    pub(super) seconds: f64,
    pub(super) right: Right,
    pub(super) why: &'static str,
    pub(super) known_miss: Option<&'static str>,
}

impl Example {
    /// Parses the file. `seed` gives concurrent runs separate temporary folders.
    pub(super) fn structure(&self, seed: u64) -> Result<Structure, ValidateError> {
        let text = (self.shortened)(self.text);
        if !text.contains(".mtx") {
            return Ok(Structure::parse(&text, Path::new(self.name))?);
        }
        let directory = format!("spandrel-fit-{}-{}-{seed}", self.name, std::process::id());
        let directory = std::env::temp_dir().join(directory);
        write_matrices(&directory.join("matrices"))?;
        let structure = Structure::parse(&text, &directory.join(self.name));
        std::fs::remove_dir_all(&directory).map_err(|reason| ValidateError::File {
            path: directory,
            reason,
        })?;
        Ok(structure?)
    }
}

fn write_matrices(directory: &Path) -> Result<(), ValidateError> {
    let failed = |path: &Path| {
        let path = PathBuf::from(path);
        |reason| ValidateError::File { path, reason }
    };
    std::fs::create_dir_all(directory).map_err(failed(directory))?;
    for (name, text) in MATRICES {
        let path = directory.join(name);
        std::fs::write(&path, text).map_err(failed(&path))?;
    }
    Ok(())
}

fn as_it_is(text: &str) -> String {
    text.to_owned()
}

/// Returns the tower with twelve beams at 50 Hz. With the original file, the ten periods before the
/// first verdict take half an hour.
fn twelve_beams(text: &str) -> String {
    /// Sensor nodes of the whole tower and the nearest nodes of the shorter one.
    const LEVELS: [(usize, usize); 8] = [
        (4, 1),
        (8, 2),
        (13, 4),
        (18, 5),
        (23, 7),
        (27, 8),
        (32, 10),
        (37, 12),
    ];
    let shorter = [
        ("elements = 27", "elements = 8"),
        ("elements = 10", "elements = 4"),
    ];
    let slower = ("sampling-rate-hz = 500", "sampling-rate-hz = 50");
    let changed = shorter
        .into_iter()
        .chain([slower])
        .fold(text.to_owned(), |text, (from, to)| text.replace(from, to));
    LEVELS.iter().fold(changed, |text, (node, nearest)| {
        text.replace(&format!("\"node-{node}-"), &format!("\"node-{nearest}-"))
    })
}

macro_rules! examples {
    ($($name:literal $seconds:literal $weight:literal $right:ident $(, $shortened:ident)?: $why:literal $(, missed $missed:literal)?;)*) => {
        /// One case per example.
        pub(crate) static CASES: &[Case] = &[$(Case {
            name: concat!("fit.", $name),
            title: concat!($name, ".toml. ", $why),
            source: "Example files, each simulated by its own plan",
            weight: $weight,
            run: |run| measure(run, &Example {
                name: $name,
                text: include_str!(concat!("../../../../docs/examples/", $name, ".toml")),
                #[allow(unused_assignments, unused_mut, reason = "most files are taken as they \
                                                                  are")]
                shortened: {
                    let mut shortened: fn(&str) -> String = as_it_is;
                    $(shortened = $shortened;)?
                    shortened
                },
                seconds: $seconds,
                right: Right::$right,
                why: $why,
                #[allow(unused_assignments, unused_mut, reason = "most verdicts are right")]
                known_miss: {
                    let mut missed = None;
                    $(missed = Some($missed);)?
                    missed
                },
            }),
        }),*];
    };
}

examples![
    "bouc-wen-five" 60.0 6.0 Supported: "The springs yield as the file says, and nothing happens \
                                         in the first 60 s", missed "the filters of model classes \
                                                                     do not measure their fit, so \
                                                                     there is no verdict";
    "bouc-wen-ten" 120.0 8.0 Supported: "The springs yield as the file says; one loss at 100 s";
    "corrupted-oscillator" 320.0 0.3 Supported: "Wrong samples, which are screened; one loss at \
                                                 200 s", missed "chance correlations in the first \
                                                                 15 s, when the measures know \
                                                                 little; and after the loss the \
                                                                 doubt lasts longer than two \
                                                                 half-lives, because the measures \
                                                                 remember eight memories of the \
                                                                 filter";
    "dashpot-building" 60.0 0.3 Supported: "Its own model; one loss from 8 to 10 \
                                            s", missed "without the loss it is supported 98 to \
                                                        99.7 % of the time; of the loss, \
                                                        estimates need longer than two half-lives \
                                                        (which are four periods) to recover, and \
                                                        the measures remember longer still";
    "demo" 120.0 0.3 Supported: "Its own model; one loss at 60 s";
    "demo-distributed" 0.0 0.3 NoVerdict: "Sensor nodes identify; no verdict on their fit";
    "dome" 140.0 11.0 Supported: "Its own model; one loss at 100 s";
    "dome-bars" 50.0 17.0 Supported: "Its own model, and nothing happens in the first 50 \
                                      s", missed "the filters of model classes do not measure \
                                                  their fit, so there is no verdict";
    "fifty-storeys" 5.0 3.0 NoVerdict: "No parameter is identified; no verdict on the fit";
    "fifty-storeys-wind" 5.0 3.0 NoVerdict: "No parameter is identified; no verdict on the fit";
    "five-mass-chain" 60.0 0.3 Supported: "Its own model; the truth is 2.3 deviations from the \
                                           prior at most";
    "forty-storey-building" 0.0 0.1 NoVerdict: "Sensor nodes identify; no verdict on their fit";
    "forty-storey-spikes" 0.0 0.1 NoVerdict: "Sensor nodes identify; no verdict on their fit";
    "fourteen-bay-truss" 95.0 9.0 Supported: "Its own model, and nothing happens in the first 95 s";
    "high-rise" 60.0 6.0 Supported: "Its own model, and nothing happens in the first 60 \
                                     s", missed "the filters of model classes do not measure \
                                                 their fit, so there is no verdict";
    "hysteretic-oscillator" 300.0 0.3 Supported: "The spring yields as the file says";
    "hysteretic-particles" 20.0 2.0 NoVerdict: "Particles identify; no verdict on their fit";
    "matrices" 120.0 0.3 Supported: "Its own model";
    "noisy" 240.0 0.3 Doubtful: "Its data have clocks that disagree by up to 3 ms and unscreened \
                                 spikes, which its model lacks; its structure is right";
    "output-only" 240.0 0.3 Supported: "Its own model; one loss at 60 s";
    "shake-table-flexible" 120.0 0.3 Supported: "Its own model; the band limit colours the \
                                                 noise", missed "without the band limit it is \
                                                                 supported 98 % of the time; with \
                                                                 it the estimates of seed 2 go \
                                                                 astray, and the verdict is then \
                                                                 right";
    "shake-table-stiff" 120.0 0.3 Supported: "Its own model; the band limit colours the \
                                              noise", missed "without the band limit it is \
                                                              supported 97 % of the time; what is \
                                                              left of the noise is correlated";
    "sixteen-bay-truss" 0.0 0.1 NoVerdict: "Sensor nodes identify; no verdict on their fit";
    "sixty-storeys" 20.0 0.3 NoVerdict: "No parameter is identified; no verdict on the fit";
    "slow-oscillator" 600.0 0.3 Supported: "Its own model; the truth lies within one deviation of \
                                            the prior", missed "a memory of one period knows the \
                                                                damping to 26 times its value: it \
                                                                comes to its lower bound";
    "three-pier-bridge" 95.0 9.0 Supported: "Its own model, and nothing happens in the first 95 s";
    "tower" 150.0 5.0 Supported, twelve_beams: "Its own model, with twelve beams in place of 37 \
                                                at 50 Hz in place of 500";
    "two-degrees-of-freedom" 0.0 0.1 NoVerdict: "Sensor nodes identify; no verdict on their fit";
    "two-pier-bridge" 0.0 0.1 NoVerdict: "Sensor nodes identify; no verdict on their fit";
    "vehicle" 600.0 0.3 NoVerdict: "No parameter is identified; no verdict on the fit";
];

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_example_file_has_a_case() {
        let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples");
        let paths = std::fs::read_dir(directory)
            .unwrap()
            .map(|entry| entry.unwrap().path());
        let files = paths.filter(|path| {
            path.extension()
                .is_some_and(|extension| extension == "toml")
        });
        let files: BTreeSet<String> = files
            .map(|path| format!("fit.{}", path.file_stem().unwrap().to_string_lossy()))
            .collect();
        assert_eq!(
            CASES
                .iter()
                .map(|case| case.name.to_owned())
                .collect::<BTreeSet<_>>(),
            files
        );
    }
}
