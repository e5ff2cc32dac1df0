//! The structure file with which the robustness benchmark identifies its building.

use std::fmt::Write as _;

/// Statements of the building's owner.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Stated {
    pub(super) rate_hz: f64,
    /// Whether a sensor measures the ground.
    pub(super) ground_measured: bool,
    /// Level of the ground motion, as the standard deviation of one sample (m/s²).
    pub(super) ground_std: f64,
    /// Noise of each floor channel (m/s²).
    pub(super) noise_std: f64,
    /// Noise of the ground channel (m/s²), if a sensor measures the ground.
    pub(super) ground_noise_std: f64,
    /// Whether the samples are screened for outliers.
    pub(super) outliers: bool,
    /// Whether the two Rayleigh coefficients are identified.
    pub(super) damping_identified: bool,
    /// Loss of the alert rule, as a share.
    pub(super) rule_loss: f64,
    /// Additional lines of `[filter]`.
    pub(super) filter: String,
}

pub(super) const STOREYS: usize = 5;
pub(super) const MASS_KG: f64 = 20_000.0;
pub(super) const FIRST_FREQUENCY_HZ: f64 = 1.0;
pub(super) const DAMPING_RATIO: f64 = 0.02;
/// Time in which the reference is learnt (s).
pub(super) const LEARN_S: f64 = 30.0;

impl Stated {
    pub(super) fn text(&self) -> String {
        let Self {
            rate_hz,
            noise_std,
            ground_noise_std,
            ..
        } = self;
        let mut text = format!(
            "[structure]\nname = \"building\"\nsampling-rate-hz = {rate_hz}\n\n\
             [model]\nkind = \"shear-building\"\nstoreys = {STOREYS}\nmass-kg = {MASS_KG}\n\
             first-frequency-hz = {FIRST_FREQUENCY_HZ}\n\n\
             [damping]\nkind = \"rayleigh\"\nratio = {DAMPING_RATIO}\nmodes = [1, 2]\n"
        );
        for storey in 1..=STOREYS {
            let _ = write!(
                text,
                "\n[[parameter]]\nname = \"storey-{storey}\"\nscales = \"stiffness\"\n\
                 of = [\"storey-{storey}\"]\nstd = 0.2\n"
            );
        }
        if self.damping_identified {
            for part in ["alpha", "beta"] {
                let _ = write!(
                    text,
                    "\n[[parameter]]\nname = \"damping-{part}\"\nscales = \"damping-{part}\"\n\
                     std = 1.0\n"
                );
            }
        }
        let _ = write!(
            text,
            "\n[[excitation]]\nname = \"ground\"\nkind = \"ground\"\nstd = {}\n",
            self.ground_std
        );
        if !self.ground_measured {
            text += "adapt = true\n";
        }
        if self.ground_measured {
            text += "measured-on = \"ground\"\n\n[[node]]\nname = \"ground\"\n\n[[node.channel]]\n\
                     name = \"ground\"\n\
                     quantity = \"ground-acceleration\"\nunit = \"m/s2\"\n";
            let _ = writeln!(text, "noise-std = {ground_noise_std}");
        }
        for floor in 1..=STOREYS {
            let _ = write!(
                text,
                "\n[[node]]\nname = \"floor-{floor}\"\n\n[[node.channel]]\n\
                 name = \"floor-{floor}\"\n\
                 quantity = \"absolute-acceleration\"\ndof = \"floor-{floor}\"\nunit = \"m/s2\"\n\
                 noise-std = {noise_std}\nnoise-group = \"floors\"\nadapt-noise = true\n"
            );
        }
        if self.outliers {
            text += "\n[outliers]\n";
        }
        let stiffness: Vec<String> = (1..=STOREYS)
            .map(|storey| format!("\"storey-{storey}\""))
            .collect();
        let _ = write!(
            text,
            "\n[filter]\n{}\n[[alert]]\nparameters = [{}]\nloss = {}\ncredibility = 0.99\n\
             sustain-s = 5\nreference = {{ learn-s = {LEARN_S} }}\n",
            self.filter,
            stiffness.join(", "),
            self.rule_loss
        );
        text
    }
}
