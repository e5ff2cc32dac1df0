//! Channels that move with the ground far below the first natural frequency.
//!
//! In this band, the structure follows the ground almost rigidly, regardless of its stiffness. All
//! accelerometers along one direction then measure nearly the same motion.

use crate::excitation::Action;
use crate::node::Quantity;
use crate::structure::Structure;
use nalgebra::{Complex, DVector};

/// Smallest share of the mass that a mode must move to count as the first mode of a direction.
const LEAST_MASS_SHARE: f64 = 0.05;

/// Largest influence of a direction that counts as none.
const NO_INFLUENCE: f64 = 1e-6;

/// The accelerometers along one direction of ground motion, with their response to it.
#[derive(Debug, Clone)]
pub struct CommonMotion {
    members: Vec<Member>,
    modes: Vec<Mode>,
    fundamental_hz: f64,
}

/// A channel that takes part in the common motion.
#[derive(Debug, Clone)]
struct Member {
    channel: usize,
    noise_std: f64,
    /// Acceleration for a slow ground acceleration of 1: 1 for the ground itself.
    rigid: f64,
    /// `φ Γ` of each mode at the sensed point; empty for the ground.
    participation: Vec<f64>,
}

#[derive(Debug, Clone, Copy)]
struct Mode {
    frequency_hz: f64,
    damping_ratio: f64,
}

impl CommonMotion {
    /// Returns the channel of each member, as its index in a frame. The ground is the first.
    pub fn channels(&self) -> impl Iterator<Item = usize> + '_ {
        self.members.iter().map(|member| member.channel)
    }

    /// Returns the stated noise of each member (standard deviation, m/s²).
    pub fn noise_std(&self) -> impl Iterator<Item = f64> + '_ {
        self.members.iter().map(|member| member.noise_std)
    }

    /// Returns the frequency of the lowest mode that moves a relevant share of the mass (Hz).
    #[must_use]
    pub fn fundamental_hz(&self) -> f64 {
        self.fundamental_hz
    }

    /// Returns the modes: frequency (Hz) and damping ratio as designed, the lowest first.
    pub fn modes(&self) -> impl Iterator<Item = (f64, f64)> + '_ {
        let modes = self.modes.iter();
        modes.map(|mode| (mode.frequency_hz, mode.damping_ratio))
    }

    /// Returns the acceleration of each member for a slow ground acceleration of 1, and the
    /// participation φ Γ of each mode at it. The ground has no participation.
    pub fn shapes(&self) -> impl Iterator<Item = (f64, &[f64])> + '_ {
        let members = self.members.iter();
        members.map(|member| (member.rigid, member.participation.as_slice()))
    }

    /// Returns the acceleration that a member measures for a ground acceleration of 1 at a
    /// frequency (Hz), with the stiffness as designed.
    ///
    /// `r + Σ φ Γ ω²/(ωₘ² − ω² + 2iζₘωₘω)` with the rigid response `r`.
    ///
    /// # Panics
    /// Panics if there is no such member.
    #[must_use]
    pub fn response(&self, member: usize, frequency_hz: f64) -> Complex<f64> {
        let member = &self.members[member];
        let modes = self.modes.iter().zip(&member.participation);
        let elastic = modes.map(|(mode, participation)| {
            let ratio = frequency_hz / mode.frequency_hz;
            let denominator = Complex::new(1.0 - ratio * ratio, 2.0 * mode.damping_ratio * ratio);
            Complex::from(participation * ratio * ratio) / denominator
        });
        Complex::from(member.rigid) + elastic.sum::<Complex<f64>>()
    }
}

impl Structure {
    /// Returns the groups of channels with a common motion: one per measured direction of ground
    /// motion, with at least one accelerometer on the structure.
    ///
    /// There is none if a force acts, because the structure then moves without the ground.
    #[must_use]
    pub fn common_motions(&self) -> Vec<CommonMotion> {
        let directions: Option<Vec<&Vec<f64>>> = self
            .excitations()
            .iter()
            .map(|excitation| match &excitation.action {
                Action::Ground { influence } => Some(influence),
                Action::Force { .. } | Action::ForceField(_) => None,
            })
            .collect();
        let Some(directions) = directions else {
            return Vec::new();
        };
        let groups = (0..directions.len()).filter_map(|own| self.common_motion(&directions, own));
        groups.filter(|group| group.members.len() > 1).collect()
    }

    fn common_motion(&self, directions: &[&Vec<f64>], own: usize) -> Option<CommonMotion> {
        let modes = &self.modes;
        let influence = DVector::from_column_slice(directions[own]);
        let moved = self.system.mass.to_dense() * &influence;
        let total = moved.dot(&influence);
        let participation = modes.shapes.tr_mul(&moved);
        let hz = |omega: &f64| omega / (2.0 * std::f64::consts::PI);
        let relevant = |mode: &usize| participation[*mode].powi(2) >= LEAST_MASS_SHARE * total;
        let first = (0..participation.len()).find(relevant)?;
        let fundamental_hz = hz(&modes.angular_frequencies[first]);
        let ground = self.excitation_channels().get(own).copied().flatten()?;
        let responses = self
            .channels()
            .enumerate()
            .filter_map(|(channel, described)| {
                if described.quantity() != Quantity::AbsoluteAcceleration {
                    return None;
                }
                let (dof, _) = *described.sensed.first()?;
                let along = |direction: &&Vec<f64>| direction[dof].abs() > NO_INFLUENCE;
                let is_own = along(&directions[own])
                    && directions.iter().filter(|one| along(one)).count() == 1;
                let of_mode = |mode| modes.shapes[(dof, mode)] * participation[mode];
                is_own.then(|| Member {
                    channel,
                    noise_std: described.noise_std(),
                    rigid: influence[dof],
                    participation: (0..participation.len()).map(of_mode).collect(),
                })
            });
        let measured = self.channels().nth(ground)?;
        let ground = Member {
            channel: ground,
            noise_std: measured.noise_std(),
            rigid: 1.0,
            participation: Vec::new(),
        };
        let members = std::iter::once(ground).chain(responses).collect();
        let ratios = modes.damping_ratios(&self.system);
        let frequencies = modes.angular_frequencies.iter().map(hz);
        let described = frequencies.zip(ratios);
        Some(CommonMotion {
            members,
            modes: described
                .map(|(frequency_hz, damping_ratio)| Mode {
                    frequency_hz,
                    damping_ratio,
                })
                .collect(),
            fundamental_hz: (fundamental_hz > 0.0).then_some(fundamental_hz)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const DEMO: &str = include_str!("../../../docs/examples/shake-table-stiff.toml");

    #[test]
    fn response_solves_the_equation_of_motion_in_the_frequency_domain() {
        let structure = Structure::parse(DEMO, Path::new("table.toml")).unwrap();
        let groups = structure.common_motions();
        let [group] = &groups[..] else {
            panic!("{groups:?}")
        };
        assert_eq!(group.channels().collect::<Vec<_>>(), [0, 1, 2, 3]);
        assert!((group.fundamental_hz() - 7.8798).abs() < 1e-4);
        // (K + iωC − ω²M) u = −M 1 with C = αM + βK, and the acceleration 1 − ω² u.
        let stiffness = structure.system.nominal_stiffness();
        let mass = structure.system.mass.to_dense();
        let crate::linear_system::Damping::Rayleigh {
            alpha_per_s,
            beta_s,
        } = structure.system.damping
        else {
            panic!("the damping of the file is proportional")
        };
        for hz in [0.5, 2.0, 3.5] {
            let omega = 2.0 * std::f64::consts::PI * hz;
            let damping = &mass * alpha_per_s + &stiffness * beta_s;
            let dynamic = nalgebra::DMatrix::from_fn(3, 3, |i, j| {
                Complex::new(
                    stiffness[(i, j)] - omega * omega * mass[(i, j)],
                    omega * damping[(i, j)],
                )
            });
            let load = DVector::from_fn(3, |i, _| Complex::from(-mass[(i, i)]));
            let relative = dynamic.lu().solve(&load).unwrap();
            assert_eq!(group.response(0, hz), Complex::from(1.0));
            for floor in 0..3 {
                let expected = Complex::from(1.0) - relative[floor] * Complex::from(omega * omega);
                let found = group.response(floor + 1, hz);
                assert!((found - expected).norm() < 1e-9, "{found} {expected}");
            }
        }
    }

    #[test]
    fn forces_and_other_quantities_have_no_common_motion() {
        let forced = include_str!("../../../docs/examples/five-mass-chain.toml");
        let Ok(structure) = Structure::parse(forced, Path::new("chain.toml")) else {
            panic!("the example is valid")
        };
        let count = structure.common_motions().len();
        assert_eq!(count, 0, "{count} groups");
        let displaced = DEMO.replace("\"absolute-acceleration\"", "\"relative-acceleration\"");
        let structure = Structure::parse(&displaced, Path::new("table.toml")).unwrap();
        assert_eq!(structure.common_motions().len(), 0);
    }
}
