//! Finds implausible periods, masses, stiffnesses, levels and noise in the design.

use super::finding::Finding;
use crate::excitation::Action;
use crate::linear_system::Mass;
use crate::spectral_information::SpectralModel;
use crate::structure::Structure;
use spandrel_filter::InputHold;
use std::f64::consts::PI;

/// Plausible fundamental period of a building per storey (s).
///
/// Measured buildings have 0.05 to 0.2 s, from which early codes of practice estimated 0.1 s. The
/// limits are two to five times as wide.
const PERIOD_PER_STOREY_S: (f64, f64) = (0.02, 1.0);
/// Factor of a typical unit mistake: t instead of kg, kN/m instead of N/m.
const UNIT: f64 = 1000.0;
/// Ratio that the storeys of one building do not reach.
const UNEQUAL: f64 = 100.0;
/// Mass (kg) below which a floor belongs to a bench model.
const LIGHT_KG: f64 = 1000.0;
/// Plausible standard deviations of ground acceleration (m/s²): from the resolution of the best
/// sensors to twice gravity.
const GROUND: (f64, f64) = (1e-6, 20.0);
/// Share of the motion, weighted by sensor noise, that defines the recorded band.
const BAND: f64 = 0.95;
/// Relative change of the excitation by the hold that affects stiffness and damping estimates.
const HOLD_ERROR: f64 = 0.05;

impl Structure {
    /// Returns the implausible properties of the design.
    pub(super) fn design_findings(&self) -> Vec<Finding> {
        let mut findings = Vec::new();
        findings.extend(self.implausible_period());
        findings.extend(self.unequal_storeys());
        findings.extend(self.implausible_levels());
        let model = SpectralModel::new(self, &self.prior_means(), &self.expected_variances());
        if let Some((signal, band)) = model.motion(BAND) {
            findings.extend(self.weak_signals(signal.as_slice()));
            findings.extend(self.hold_that_matters(band / (2.0 * PI)));
        }
        findings
    }

    fn is_shear_building(&self) -> bool {
        !self.system.storeys.is_empty() && self.system.hysteresis.is_none()
    }

    fn implausible_period(&self) -> Option<Finding> {
        let (storeys, period_s) = (self.system.len(), self.fundamental_period_s());
        let (low, high) = PERIOD_PER_STOREY_S;
        let plausible = |period_s: f64| (low..=high).contains(&(period_s / storeys as f64));
        if !self.is_shear_building() || plausible(period_s) {
            return None;
        }
        // The period is proportional to the square root of mass over stiffness.
        let cause = if plausible(period_s * UNIT.sqrt()) {
            Some("masses must be in kg; masses in tonnes have this effect")
        } else if plausible(period_s / UNIT.sqrt()) {
            Some("stiffnesses must be in N/m; stiffnesses in kN/m have this effect")
        } else {
            None
        };
        let expected_s = (low * storeys as f64, high * storeys as f64);
        Some(Finding::ImplausiblePeriod {
            storeys,
            period_s,
            expected_s,
            cause: cause.map(str::to_owned),
        })
    }

    fn unequal_storeys(&self) -> Vec<Finding> {
        let Mass::Lumped(masses) = &self.system.mass else {
            return Vec::new();
        };
        if self.system.storeys.is_empty() {
            return Vec::new();
        }
        let stiffness = self.system.nominal_stiffness();
        let above = |storey: usize| {
            if storey < masses.len() {
                -stiffness[(storey - 1, storey)]
            } else {
                0.0
            }
        };
        let springs: Vec<f64> = (1..=masses.len())
            .map(|s| stiffness[(s - 1, s - 1)] - above(s))
            .collect();
        let mut findings = Vec::new();
        for (what, values) in [("mass", masses.as_slice()), ("stiffness", &springs)] {
            for (lower, pair) in values.windows(2).enumerate() {
                let ratio = (pair[1] / pair[0]).max(pair[0] / pair[1]);
                if ratio >= UNEQUAL {
                    findings.push(Finding::UnequalStoreys {
                        what: what.to_owned(),
                        lower: lower + 1,
                        ratio,
                    });
                }
            }
        }
        let heaviest_kg = masses.max();
        if heaviest_kg < LIGHT_KG {
            findings.push(Finding::LightFloors { heaviest_kg });
        }
        findings
    }

    fn implausible_levels(&self) -> Vec<Finding> {
        let grounds = self
            .excitations
            .iter()
            .filter(|excitation| matches!(excitation.action, Action::Ground { .. }));
        let (low, high) = GROUND;
        let finding = |excitation: &crate::Excitation| Finding::ImplausibleLevel {
            excitation: excitation.name.clone(),
            std: excitation.std,
        };
        grounds
            .filter(|excitation| !(low..=high).contains(&excitation.std))
            .map(finding)
            .collect()
    }

    /// Finds channels whose noise exceeds the expected motion (`signal`, standard deviations).
    fn weak_signals(&self, signal: &[f64]) -> Vec<Finding> {
        let responses =
            self.observations()
                .zip(signal)
                .enumerate()
                .filter_map(|(row, (channel, signal))| {
                    let noise = self.expected_noise_std(row);
                    (noise > *signal).then(|| Finding::NoiseAboveSignal {
                        channel: channel.name().to_owned(),
                        noise,
                        signal: *signal,
                        unit: channel.quantity().unit().to_owned(),
                    })
                });
        let measured = self
            .excitations
            .iter()
            .filter(|excitation| excitation.channel().is_some());
        let measured = measured
            .filter(|excitation| excitation.unknown_std() > excitation.std)
            .map(|excitation| {
                let channel = self
                    .channels()
                    .nth(excitation.channel().unwrap_or_default());
                Finding::NoiseAboveSignal {
                    channel: channel.map_or_else(String::new, |channel| channel.name().to_owned()),
                    noise: excitation.unknown_std(),
                    signal: excitation.std,
                    unit: excitation.unit().to_owned(),
                }
            });
        responses.chain(measured).collect()
    }

    fn expected_noise_std(&self, row: usize) -> f64 {
        use crate::noise_level::NoiseSource;
        let of_row = |source: &NoiseSource| matches!(source, NoiseSource::Sensors(rows) if rows.contains(&row));
        let level = self
            .noise_levels
            .iter()
            .position(|level| of_row(level.source()));
        level.map_or(0.0, |level| self.expected_level_std(level))
    }

    /// Reports the effect of the hold on a measured excitation at the upper end of the recorded
    /// band (Hz).
    ///
    /// An excitation held over a step Δt is late by half a step and weaker by sinc(*f* Δt). A
    /// linearly interpolated excitation is not late, but weaker by sinc²(*f* Δt).
    fn hold_that_matters(&self, band_hz: f64) -> Option<Finding> {
        self.excitations
            .iter()
            .find(|excitation| excitation.channel().is_some())?;
        let frequency_hz = self
            .band_limit
            .map_or(band_hz, |limit| band_hz.min(limit.frequency_hz));
        let half_turn = PI * frequency_hz * self.step_s();
        let sinc = if half_turn > 0.0 {
            half_turn.sin() / half_turn
        } else {
            1.0
        };
        let (gain, delay_s, error) = match self.plan.input_hold {
            InputHold::Zero => {
                let error = (1.0 - sinc * half_turn.cos()).hypot(sinc * half_turn.sin());
                (sinc, 0.5 * self.step_s(), error)
            }
            InputHold::First => (sinc * sinc, 0.0, 1.0 - sinc * sinc),
        };
        (error > HOLD_ERROR).then_some(Finding::HoldMatters {
            frequency_hz,
            loss: 1.0 - gain,
            delay_s,
            error,
        })
    }
}
