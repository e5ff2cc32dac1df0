//! Shapes that represent the motion of a large model in the analysis of its sensors.
//!
//! The analysis solves Riccati equations and frequency responses of `[x, ẋ]`, whose cost grows with
//! the cube of the degrees of freedom. A large model therefore moves in few shapes, `x = Φ q` with
//! `Φᵀ M Φ = I`.
//!
//! The shapes span the responses `Z⁻¹ p` of the model at many frequencies, with the dynamic
//! stiffness `Z = K + iωC − ω²M`, to the forces of the excitations and to unit forces at the
//! sensors. The motion at the sensors is then right, and so is its sensitivity to a stiffness,
//! `−cᵀ Z⁻¹ K′ Z⁻¹ p`. The lowest modes do not suffice: in a tall building, fast modes cancel each
//! other far from the ground, and without some of them, the sensors would seem to see stiffness
//! there that they do not see.
//!
//! Sources: Grimme (1997), PhD thesis, University of Illinois, for interpolation with the responses
//! of both sides; Willcox & Peraire (2002), *AIAA Journal* 40, 2323–2330, for principal components
//! of responses over the frequency.

use crate::excitation::Action;
use crate::structure::Structure;
use nalgebra::{Complex, DMatrix, DVector, SymmetricEigen};
use std::f64::consts::PI;

/// Number of degrees of freedom up to which the analysis uses the model as it is.
pub(crate) const LARGEST_WHOLE: usize = 200;

/// Largest number of shapes.
const MOST_SHAPES: usize = 100;

/// Largest number of forces of each side, evenly chosen of a larger number.
const MOST_FORCES: usize = 40;

/// Number of frequencies between zero and half the sampling rate.
const FREQUENCIES: usize = 100;

/// Share of the squared responses to a force that the shapes may omit.
const OMITTED: f64 = 1e-10;

/// Shapes of the motion.
#[derive(Debug, Clone)]
pub(crate) struct RitzBasis {
    /// `Φ` (N_d × r), with `Φᵀ M Φ = I`.
    pub(crate) shapes: DMatrix<f64>,
    /// `Φᵀ M` (r × N_d), which returns `q` from `x = Φ q`.
    pub(crate) shares: DMatrix<f64>,
}

impl Structure {
    /// Returns the shapes for the analysis of a large model; `None` if it is analysed as it is.
    pub(crate) fn analysis_basis(&self) -> Option<&RitzBasis> {
        let basis = || (self.system.len() > LARGEST_WHOLE).then(|| self.basis(MOST_SHAPES));
        self.analysis_basis.get_or_init(basis).as_ref()
    }

    fn basis(&self, most: usize) -> RitzBasis {
        let mass = self.system.mass.to_dense();
        // In the coordinates of all modes, M is the identity. Only the damping may couple them, and
        // this coupling is neglected here: the shapes need to span the responses, not to state them.
        let squares = self.squared_responses(&mass);
        let eigen = SymmetricEigen::new(squares);
        let mut order: Vec<usize> = (0..eigen.eigenvalues.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        let limit = OMITTED * eigen.eigenvalues.sum();
        order.retain(|at| eigen.eigenvalues[*at] > limit);
        order.truncate(most);
        let shapes = &self.modes.shapes * eigen.eigenvectors.select_columns(&order);
        RitzBasis {
            shares: shapes.tr_mul(&mass),
            shapes,
        }
    }

    /// Returns `Σ w a aᵀ` over the responses `a` (in modes) to all forces at all frequencies, with
    /// the response to each force at rest. The weight makes the sum of squares of the accelerations
    /// one for each force, and the square of the response at rest, too.
    ///
    /// The modes respond to every force `l` (in modes) by the same receptances `h(ω)`, so that the
    /// sum over the frequencies is `(l lᵀ) ∘ G` with `G = Re Σ h hᴴ`.
    fn squared_responses(&self, mass: &DMatrix<f64>) -> DMatrix<f64> {
        let omegas = DVector::from_column_slice(&self.modes.angular_frequencies);
        let moving = self.squared_receptances();
        let softness = omegas.map(|omega| omega.powi(-2));
        let forces = [self.excitation_forces(mass), self.sensor_forces()];
        let mut of_moving = DMatrix::zeros(omegas.len(), omegas.len());
        let mut of_still = of_moving.clone();
        for force in forces.iter().flat_map(|forces| chosen(forces)) {
            let loads = self.modes.shapes.tr_mul(force); // Φᵀ p
            let squares = loads.component_mul(&loads);
            let level = squares.dot(&moving.diagonal()); // Σ |a|²
            let still = loads.component_mul(&softness).norm_squared();
            if level > 0.0 {
                of_moving.ger(1.0 / level, &loads, &loads, 1.0);
                of_still.ger(1.0 / still, &loads, &loads, 1.0);
            }
        }
        of_still.component_mul_assign(&(&softness * softness.transpose()));
        of_moving.component_mul(&moving) + of_still
    }

    /// Returns `G = Re Σ h hᴴ` of the accelerations `h` of the modes under a unit force on each,
    /// over the frequencies up to half the sampling rate.
    fn squared_receptances(&self) -> DMatrix<f64> {
        let omegas = &self.modes.angular_frequencies;
        let ratios = self.modes.damping_ratios(&self.system);
        let highest = PI / self.step_s(); // half the sampling rate
        let even = (1..=FREQUENCIES).map(|k| highest * k as f64 / FREQUENCIES as f64);
        let resonances = omegas.iter().copied().filter(|omega| *omega < highest);
        let frequencies: Vec<f64> = even.chain(resonances).collect();
        let receptance = |mode: usize, by: f64| {
            let omega = omegas[mode];
            let stiffness = Complex::new(omega * omega - by * by, 2.0 * ratios[mode] * omega * by);
            -by * by / stiffness
        };
        let parts = [|h: Complex<f64>| h.re, |h: Complex<f64>| h.im];
        let mut sum = DMatrix::zeros(omegas.len(), omegas.len());
        for part in parts {
            let responses = DMatrix::from_fn(omegas.len(), frequencies.len(), |mode, at| {
                part(receptance(mode, frequencies[at]))
            });
            sum.gemm(1.0, &responses, &responses.transpose(), 1.0);
        }
        sum
    }

    /// Returns the spatial distribution of the force of each excitation component (N_d).
    fn excitation_forces(&self, mass: &DMatrix<f64>) -> Vec<DVector<f64>> {
        let of_excitation = |excitation: &crate::Excitation| match &excitation.action {
            Action::Ground { influence } => vec![mass * DVector::from_column_slice(influence)],
            Action::Force { degree_of_freedom } => vec![self.force(&[(*degree_of_freedom, 1.0)])],
            Action::ForceField(field) => {
                let dofs = field.degrees_of_freedom.iter();
                dofs.map(|dof| self.force(&[(*dof, 1.0)])).collect()
            }
        };
        self.excitations.iter().flat_map(of_excitation).collect()
    }

    /// Returns a force in the place and direction of each response channel (N_d).
    fn sensor_forces(&self) -> Vec<DVector<f64>> {
        let channels: Vec<_> = self.channels().collect();
        let observed = self.observation_channels.iter();
        observed
            .map(|at| self.force(&channels[*at].sensed))
            .collect()
    }

    fn force(&self, parts: &[(usize, f64)]) -> DVector<f64> {
        let mut force = DVector::zeros(self.system.len());
        for (dof, part) in parts {
            force[*dof] += part;
        }
        force
    }
}

/// Returns at most [`MOST_FORCES`] forces, evenly chosen.
fn chosen(forces: &[DVector<f64>]) -> impl Iterator<Item = &DVector<f64>> {
    let most = forces.len().min(MOST_FORCES);
    (0..most).map(move |at| &forces[at * forces.len() / most])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linear_system::Damping;
    use std::f64::consts::TAU;
    use std::path::Path;

    /// A tall building under ground motion, just too large to be analysed as it is.
    const TALL: &str = "
        [structure]
        name = \"tall\"
        sampling-rate-hz = 50
        [model]
        kind = \"shear-building\"
        storeys = 201
        mass-kg = 20_000
        first-frequency-hz = 0.15
        [damping]
        kind = \"rayleigh\"
        ratio = 0.02
        modes = [1, 2]
        [[parameter]]
        name = \"damping\"
        scales = \"damping\"
        of = \"all\"
        std = 0.2
        [[excitation]]
        name = \"ground\"
        kind = \"ground\"
        std = 0.1
        measured-on = \"ground\"
        [[node]]
        name = \"site\"
        [[node.channel]]
        name = \"ground\"
        quantity = \"ground-acceleration\"
        unit = \"m/s2\"
        noise-std = 0.005
        [[node.channel]]
        name = \"roof\"
        quantity = \"absolute-acceleration\"
        dof = \"floor-201\"
        unit = \"m/s2\"
        noise-std = 0.005
    ";

    /// Motion of the roof under the ground motion at ω, and its change with the stiffness of the
    /// lower half of the building, both in the shapes of `basis`.
    fn motion(structure: &Structure, basis: &RitzBasis, omega: f64) -> [Complex<f64>; 2] {
        let modal = |matrix: &DMatrix<f64>| basis.shapes.tr_mul(&(matrix * &basis.shapes));
        let mass = structure.system.mass.to_dense();
        let stiffness = |parts: &dyn Fn(usize) -> f64| {
            let mut sum = DMatrix::zeros(mass.nrows(), mass.ncols());
            for (number, part) in structure.system.substructures.iter().enumerate() {
                for (row, column, value) in part.stiffness.triplet_iter() {
                    sum[(row, column)] += parts(number) * value;
                }
            }
            sum
        };
        let lower = |number: usize| f64::from(u8::from(number < 100));
        let (k, change) = (modal(&stiffness(&|_| 1.0)), modal(&stiffness(&lower)));
        let Damping::Rayleigh {
            alpha_per_s,
            beta_s,
        } = structure.system.damping
        else {
            panic!("Rayleigh damping");
        };
        let damped = Complex::new(1.0, omega * beta_s);
        let rest = Complex::new(-omega * omega, omega * alpha_per_s);
        let z = k.map(|value| damped * value)
            + DMatrix::<Complex<f64>>::identity(k.nrows(), k.nrows()) * rest;
        let z = z.lu();
        let complex = |values: DVector<f64>| values.map(|value| Complex::new(value, 0.0));
        let ground = &structure.excitation_forces(&mass)[0];
        let roof = &structure.sensor_forces()[0];
        let x = z.solve(&complex(basis.shapes.tr_mul(ground))).unwrap();
        let y = z.solve(&complex(basis.shapes.tr_mul(roof))).unwrap();
        let moved = change.map(|value| damped * value) * &x;
        [complex(basis.shapes.tr_mul(roof)).dot(&x), -y.dot(&moved)]
    }

    /// Every force and frequency by itself, the plain form of the sum.
    #[test]
    fn squared_responses_are_the_sum_over_forces_and_frequencies() {
        let text = include_str!("../../../docs/examples/demo.toml");
        let structure = Structure::parse(text, Path::new("demo.toml")).unwrap();
        let mass = structure.system.mass.to_dense();
        let omegas = &structure.modes.angular_frequencies;
        let ratios = structure.modes.damping_ratios(&structure.system);
        let highest = PI / structure.step_s();
        let even = (1..=FREQUENCIES).map(|k| highest * k as f64 / FREQUENCIES as f64);
        let frequencies = even.chain(omegas.iter().copied().filter(|omega| *omega < highest));
        let frequencies: Vec<f64> = frequencies.collect();
        let mut expected = DMatrix::zeros(omegas.len(), omegas.len());
        let forces = [
            structure.excitation_forces(&mass),
            structure.sensor_forces(),
        ];
        for force in forces.iter().flatten() {
            let loads = structure.modes.shapes.tr_mul(force);
            let moving = DMatrix::from_fn(omegas.len(), frequencies.len(), |mode, at| {
                let (omega, by) = (omegas[mode], frequencies[at]);
                let damping = 2.0 * ratios[mode] * omega * by;
                -by * by * loads[mode] / Complex::new(omega * omega - by * by, damping)
            });
            let still =
                DVector::from_fn(omegas.len(), |mode, _| loads[mode] / omegas[mode].powi(2));
            let squares = &moving * moving.adjoint() / Complex::from(moving.norm_squared());
            expected += squares.map(|entry| entry.re);
            expected += &still * still.transpose() / still.norm_squared();
        }
        let found = structure.squared_responses(&mass);
        assert!((found - &expected).norm() < 1e-12 * expected.norm());
    }

    #[test]
    fn reduced_model_and_its_sensitivity_agree_with_the_whole_one_in_the_sampled_band() {
        let structure = Structure::parse(TALL, Path::new("tall.toml")).unwrap();
        let reduced = structure.analysis_basis().unwrap().clone();
        let whole = RitzBasis {
            shapes: structure.modes.shapes.clone(),
            shares: structure
                .modes
                .shapes
                .tr_mul(&structure.system.mass.to_dense()),
        };
        // Accelerations: far from the ground, the fast motion and its sensitivity fade to nothing.
        let mut largest = [0.0_f64; 2];
        let mut errors = [0.0_f64; 2];
        for hertz in [0.01, 0.15, 0.3, 0.5, 1.0, 2.03, 5.07, 10.0, 17.0, 24.0] {
            let omega = TAU * hertz;
            let [exact, found] = [&whole, &reduced].map(|basis| motion(&structure, basis, omega));
            for part in 0..2 {
                let acceleration = |value: Complex<f64>| omega * omega * value.norm();
                largest[part] = largest[part].max(acceleration(exact[part]));
                errors[part] = errors[part].max(acceleration(exact[part] - found[part]));
            }
        }
        let shares = [errors[0] / largest[0], errors[1] / largest[1]];
        assert!(shares.iter().all(|share| *share < 1e-4), "{shares:?}");
    }
    /// The error of the shapes must cancel between the model and the truth, because many sensors
    /// see it.
    #[test]
    fn wrong_damping_shifts_a_reduced_model_as_it_shifts_the_whole_one() {
        let group = |number: usize| {
            let (name, first, last) = (format!("part-{number}"), 2 * number - 1, 2 * number);
            format!(
                "[[model.group]]\nname = \"{name}\"\nstoreys = [{first}, {last}]\n\
                 [[parameter]]\nname = \"{name}\"\nscales = \"stiffness\"\nof = [\"{name}\"]\n\
                 std = 0.2\n"
            )
        };
        let sensor = |number: usize| {
            let floor = 2 * number;
            format!(
                "[[node.channel]]\nname = \"floor-{floor}\"\ndof = \"floor-{floor}\"\n\
                 quantity = \"absolute-acceleration\"\nunit = \"m/s2\"\nnoise-std = 0.005\n"
            )
        };
        let (model, rest) = TALL.split_once("[damping]").unwrap();
        let (damping, rest) = rest.split_once("[[parameter]]").unwrap();
        let (_, sensors) = rest.split_once("[[excitation]]").unwrap();
        let groups: String = (1..=12).map(group).collect();
        let more: String = (1..=11).map(sensor).collect();
        let text = format!("{model}{groups}[damping]{damping}[[excitation]]{sensors}{more}");
        let whole = Structure::parse(&text.replace("201", "24"), Path::new("tall.toml")).unwrap();
        let reduced = whole.clone();
        let basis = reduced.basis(18);
        reduced.analysis_basis.get_or_init(|| Some(basis));
        let [expected, found] = [&whole, &reduced].map(|of| of.shifts_by_damping(2.0).unwrap());
        for (expected, found) in expected.iter().zip(&found) {
            let apart = (expected - found).abs();
            assert!(apart < 0.1, "{found} for {expected}");
        }
    }
}
