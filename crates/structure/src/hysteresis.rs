//! The Bouc-Wen law: a spring force that depends on the history of the spring's displacement.
//!
//! `ṙ = a w − μ |w| |r|^(η−1) r − κ w |r|^η`: Huang & Yuen (2023), (2.88), which omits the factor
//! `a` (it is 1 there). `r` (m) is the hysteretic displacement of a spring and `w` (m/s) the
//! velocity that drives it. The spring force is `k r`. `|r|` stays below `(a/(μ + κ))^(1/η)`. For
//! small motions, `ṙ = a w`, so the spring is linear with the stiffness `a k`.

/// The velocity that drives the hysteretic displacement of each spring of a chain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Drive {
    /// The velocity of the floor above the spring, as in the source. The forces are `K r`.
    Floor,
    /// The drift rate of the spring, as for a device between two floors. The forces act at its
    /// ends.
    Drift,
}

impl Drive {
    /// Writes `w = D ẋ` (N_d, m/s).
    pub(crate) fn drive_to(self, velocity: &[f64], out: &mut [f64]) {
        out.copy_from_slice(velocity);
        if self == Self::Drift {
            for (entry, below) in out[1..].iter_mut().zip(velocity) {
                *entry -= below;
            }
        }
    }

    /// Returns the velocities that contribute to one entry of `w = D ẋ`, with their signs.
    pub(crate) fn of_velocities(self, spring: usize) -> [Option<(usize, f64)>; 2] {
        let below = spring.checked_sub(1).filter(|_| self == Self::Drift);
        [Some((spring, 1.0)), below.map(|below| (below, -1.0))]
    }
}

/// A constant of the law.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Constant {
    A,
    Mu,
    Kappa,
    Eta,
}

/// The law, common to all springs of a chain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hysteresis {
    pub(crate) drive: Drive,
    /// `a` (1), `μ` and `κ` (m^−η), `η` (1).
    pub(crate) a: f64,
    pub(crate) mu: f64,
    pub(crate) kappa: f64,
    pub(crate) eta: f64,
}

/// Derivatives of `ṙ` of one spring.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Slopes {
    /// `∂ṙ/∂w` (1).
    pub(crate) by_velocity: f64,
    /// `∂ṙ/∂r` (1/s).
    pub(crate) by_displacement: f64,
}

/// Magnitude of `r` (m) below which powers of `r` count as zero.
///
/// At 0, neither their logarithm nor a negative power exists.
const SMALLEST: f64 = 1e-12;

/// Returns `|r|^exponent`, or 0 if `r` is almost 0.
fn power(r: f64, exponent: f64) -> f64 {
    if r.abs() < SMALLEST {
        0.0
    } else {
        r.abs().powf(exponent)
    }
}

/// Returns the sign, and 0 for 0, so that at rest the law is linear.
fn sign(value: f64) -> f64 {
    if value == 0.0 { 0.0 } else { value.signum() }
}

impl Hysteresis {
    /// Returns the value of a constant.
    pub(crate) fn constant(&self, constant: Constant) -> f64 {
        match constant {
            Constant::A => self.a,
            Constant::Mu => self.mu,
            Constant::Kappa => self.kappa,
            Constant::Eta => self.eta,
        }
    }

    /// Multiplies a constant by `factor`.
    pub(crate) fn scale(&mut self, constant: Constant, factor: f64) {
        match constant {
            Constant::A => self.a *= factor,
            Constant::Mu => self.mu *= factor,
            Constant::Kappa => self.kappa *= factor,
            Constant::Eta => self.eta *= factor,
        }
    }

    /// Returns `ṙ` (m/s) at `w` (m/s) and `r` (m), (2.88).
    pub(crate) fn rate(&self, w: f64, r: f64) -> f64 {
        self.a * w - (self.mu * w.abs() * sign(r) + self.kappa * w) * power(r, self.eta)
    }

    /// Returns the derivatives of `ṙ` with respect to `w` and `r`.
    pub(crate) fn slopes(&self, w: f64, r: f64) -> Slopes {
        Slopes {
            by_velocity: self.a - (self.mu * sign(w) * sign(r) + self.kappa) * power(r, self.eta),
            by_displacement: -self.eta
                * (self.mu * w.abs() + self.kappa * w * sign(r))
                * power(r, self.eta - 1.0),
        }
    }

    /// Returns the derivative of `ṙ` with respect to a constant.
    pub(crate) fn slope_by(&self, constant: Constant, w: f64, r: f64) -> f64 {
        match constant {
            Constant::A => w,
            Constant::Mu => -w.abs() * sign(r) * power(r, self.eta),
            Constant::Kappa => -w * power(r, self.eta),
            Constant::Eta if r.abs() < SMALLEST => 0.0,
            Constant::Eta => {
                -(self.mu * w.abs() * sign(r) + self.kappa * w) * power(r, self.eta) * r.abs().ln()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAW: Hysteresis = Hysteresis {
        drive: Drive::Drift,
        a: 1.0,
        mu: 1000.0,
        kappa: 1500.0,
        eta: 2.0,
    };

    #[test]
    fn steadily_pushed_spring_reaches_its_yield_amplitude() {
        let (mut r, h) = (0.0, 1e-5);
        for _ in 0..100_000 {
            r += h * LAW.rate(0.2, r);
        }
        // (μ + κ)^(−1/η)
        assert!((r - 0.02).abs() < 1e-9, "{r}");
    }

    /// Unloading follows the initial slope, but loading does not: `∂ṙ/∂w` depends on the direction
    /// of motion.
    #[test]
    fn unloading_is_stiffer_than_loading() {
        let [loading, unloading] = [0.1, -0.1].map(|w| LAW.rate(w, 0.015) / w);
        assert!(
            (loading - (1.0 - 2500.0 * 0.015_f64.powi(2))).abs() < 1e-12,
            "{loading}"
        );
        assert!(
            (unloading - (1.0 - 500.0 * 0.015_f64.powi(2))).abs() < 1e-12,
            "{unloading}"
        );
    }

    #[test]
    fn slopes_are_derivatives() {
        let law = Hysteresis {
            a: 6.0,
            mu: 0.9,
            kappa: -0.08,
            eta: 1.3,
            ..LAW
        };
        let h = 1e-6;
        for (w, r) in [(0.7, 1.1), (-0.7, 1.1), (0.7, -1.1), (-0.4, -0.3)] {
            let difference = |up: f64, down: f64| (up - down) / (2.0 * h);
            let slopes = law.slopes(w, r);
            let by_w = difference(law.rate(w + h, r), law.rate(w - h, r));
            let by_r = difference(law.rate(w, r + h), law.rate(w, r - h));
            assert!(
                (slopes.by_velocity - by_w).abs() < 1e-8
                    && (slopes.by_displacement - by_r).abs() < 1e-8
            );
            for constant in [Constant::A, Constant::Mu, Constant::Kappa, Constant::Eta] {
                let moved = |by: f64| {
                    let mut law = law;
                    law.scale(constant, 1.0 + by / law.constant(constant));
                    law.rate(w, r)
                };
                let expected = difference(moved(h), moved(-h));
                assert!(
                    (law.slope_by(constant, w, r) - expected).abs() < 1e-8,
                    "{constant:?} at {w}, {r}"
                );
            }
        }
    }

    #[test]
    fn a_spring_at_rest_is_linear() {
        for eta in [0.6, 1.0, 2.0] {
            let law = Hysteresis { a: 6.0, eta, ..LAW };
            assert_eq!(
                law.slopes(0.0, 0.0),
                Slopes {
                    by_velocity: 6.0,
                    by_displacement: 0.0
                }
            );
            assert_eq!(law.slope_by(Constant::Eta, 0.3, 0.0), 0.0);
        }
    }
}
