//! Shapes that represent the motion of a large model in the analysis of its sensors.
//!
//! The analysis solves Riccati equations and frequency responses of `[x, ẋ]`, whose cost grows with
//! the cube of the degrees of freedom. A large model therefore moves in few shapes, `x = Φ q` with
//! `Φᵀ M Φ = I`.
//!
//! The shapes span the responses `Z⁻¹ p` of the model at many frequencies, with the dynamic
//! stiffness `Z = K + iωC − ω²M`, to the forces of the excitations and to unit forces `c` at the
//! sensors. The motion at the sensors is then right, and so is its sensitivity to a stiffness,
//! `−cᵀ Z⁻¹ K′ Z⁻¹ p`. Both factors of the sensitivity must be large to matter. The response to a
//! force at a sensor therefore counts by the strain energy that the excitation causes at the same
//! frequency. The lowest modes do not suffice: in a tall building, fast modes cancel each other far
//! from the ground, and without some of them, the sensors would seem to observe stiffness there
//! that they do not observe.
//!
//! The shapes are smooth, and a change of stiffness in one storey bends them there. What lies
//! outside of the shapes is faster than the excitation and follows at once:
//! `x = Φ q − R K(θ) Φ q` with the residual flexibility `R = K⁻¹ − Φ (Φᵀ K Φ)⁻¹ Φᵀ`. With damping
//! proportional to `K`, its effect on `R` and on the force `K(θ) Φ q` cancels.
//!
//! Sources: Grimme (1997), PhD thesis, University of Illinois, for interpolation with the responses
//! of both sides; Willcox & Peraire (2002), *AIAA Journal* 40, 2323–2330, for principal components
//! of responses over the frequency; MacNeal (1971), *Computers & Structures* 1, 581–601, for the
//! residual flexibility.

use crate::excitation::Action;
use crate::node::Quantity;
use crate::structure::Structure;
use nalgebra::{Cholesky, Complex, DMatrix, DVector, SymmetricEigen};
use std::f64::consts::PI;

/// Number of degrees of freedom up to which the analysis uses the model as it is.
const LARGEST_WHOLE: usize = 100;

/// Largest number of shapes.
const MOST_SHAPES: usize = 100;

/// Number of derivatives of data with respect to unknowns from which on fewer shapes must suffice,
/// because the time grows with both.
const MANY_DERIVATIVES: usize = 15_000;

/// Largest number of shapes for many derivatives.
const FEWER_SHAPES: usize = 50;

/// Number of frequencies between zero and half the sampling rate.
const FREQUENCIES: usize = 100;

/// Share of the squared responses to a force that the shapes may omit.
const OMITTED: f64 = 1e-10;

/// Accelerations of the modes under a unit force on each.
struct Receptances {
    /// Real and imaginary part (modes × frequencies).
    parts: [DMatrix<f64>; 2],
    /// `ω²` of each mode.
    stiffness: DVector<f64>,
    /// `ω` (rad/s) of each frequency.
    frequencies: Vec<f64>,
}

/// Shapes of the motion.
#[derive(Debug, Clone)]
pub(crate) struct RitzBasis {
    /// `Φ` (N_d × r), with `Φᵀ M Φ = I`.
    pub(crate) shapes: DMatrix<f64>,
    /// `Φᵀ M` (r × N_d), which returns `q` from `x = Φ q`.
    pub(crate) shares: DMatrix<f64>,
    /// `cᵀ R M` of the sensors (N_0 × N_d) with the residual flexibility
    /// `R = K⁻¹ − Φ (Φᵀ K Φ)⁻¹ Φᵀ`.
    pub(crate) residual: DMatrix<f64>,
}

impl Structure {
    /// Returns the shapes for the analysis of a large model; `None` if it is analysed as it is.
    pub(crate) fn analysis_basis(&self) -> Option<&RitzBasis> {
        let basis = || (self.system.len() > LARGEST_WHOLE).then(|| self.basis(self.most_shapes()));
        self.analysis_basis.get_or_init(basis).as_ref()
    }

    /// Returns the number of shapes in which a check moves the structure at most: all degrees of
    /// freedom of a small one.
    pub(crate) fn most_shapes(&self) -> usize {
        let unknowns = self.parameters.len() + self.noise_levels.len();
        match unknowns * self.observation_channels.len() {
            _ if self.system.len() <= LARGEST_WHOLE => self.system.len(),
            ..MANY_DERIVATIVES => MOST_SHAPES,
            MANY_DERIVATIVES.. => FEWER_SHAPES,
        }
    }

    fn basis(&self, most: usize) -> RitzBasis {
        let mass = self.system.mass.to_dense();
        // In the coordinates of all modes, M is the identity. Only the damping may couple them, and
        // this coupling is neglected here: the shapes need to span the responses, not to state
        // them.
        let squares = self.squared_responses(&mass);
        let eigen = SymmetricEigen::new(squares);
        let mut order: Vec<usize> = (0..eigen.eigenvalues.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        let limit = OMITTED * eigen.eigenvalues.sum();
        order.retain(|at| eigen.eigenvalues[*at] > limit);
        order.truncate(most);
        let in_modes = eigen.eigenvectors.select_columns(&order);
        let shapes = &self.modes.shapes * &in_modes;
        RitzBasis {
            shares: shapes.tr_mul(&mass),
            residual: self.residual(&in_modes) * self.modes.shapes.tr_mul(&mass),
            shapes,
        }
    }

    /// Returns `cᵀ R` of the sensors (N_0 × modes) in modes, where `Φ` is `in_modes`.
    fn residual(&self, in_modes: &DMatrix<f64>) -> DMatrix<f64> {
        let sensed = self.in_modes(self.sensor_forces().iter().map(|(_, force)| force));
        let stiffness = self.modal_stiffness();
        let mut soft = sensed.clone();
        for mut column in soft.column_iter_mut() {
            column.component_div_assign(&stiffness);
        }
        let mut stiff = in_modes.clone();
        for mut column in stiff.column_iter_mut() {
            column.component_mul_assign(&stiffness);
        }
        // The stiffness is positive definite, as checked when the file was read.
        let kept = Cholesky::new(in_modes.tr_mul(&stiff)).map_or_else(
            || DMatrix::zeros(in_modes.ncols(), sensed.ncols()),
            |kept| kept.solve(&in_modes.tr_mul(&sensed)),
        );
        (soft - in_modes * kept).transpose()
    }

    /// Returns `Σ w a aᵀ` over the responses `a` (in modes) to all forces at all frequencies, and
    /// at rest. The weights `w` make the sum of squares one for each force, and for each force at
    /// rest.
    ///
    /// The modes respond to every force `l` (in modes) by the same receptances `h(ω)`, so that the
    /// sum over the frequencies is `(l lᵀ) ∘ G` with `G = Re Σ w h hᴴ`.
    fn squared_responses(&self, mass: &DMatrix<f64>) -> DMatrix<f64> {
        let excitations = self.in_modes(&self.excitation_forces(mass));
        let sensors = self.sensor_forces();
        let receptances = self.receptances();
        let mut sum = DMatrix::zeros(mass.nrows(), mass.nrows());
        let mut add = |loads: &DMatrix<f64>, squares: DMatrix<f64>| {
            let mut scaled = loads.clone();
            for mut load in scaled.column_iter_mut() {
                let level = load.component_mul(&load).dot(&squares.diagonal()); // Σ |a|²
                if level > 0.0 {
                    load /= level.sqrt();
                }
            }
            sum += (&scaled * scaled.transpose()).component_mul(&squares);
        };
        let softness = self.modal_stiffness().map(f64::recip);
        let at_rest = &softness * softness.transpose();
        let evenly = DVector::from_element(receptances.frequencies.len(), 1.0);
        add(&excitations, receptances.squares(&evenly));
        add(&excitations, at_rest.clone());
        let strain = receptances.strain(&excitations);
        let moving = self.in_modes(sensors.iter().map(|(_, force)| force));
        add(&moving, receptances.squares(&strain));
        let of_rest = |quantity| matches!(quantity, Quantity::Displacement | Quantity::Strain);
        let still = sensors.iter().filter(|(quantity, _)| of_rest(*quantity));
        add(&self.in_modes(still.map(|(_, force)| force)), at_rest);
        sum
    }

    /// Returns `Φᵀ p` of forces `p`, a column for each.
    fn in_modes<'f>(&self, forces: impl IntoIterator<Item = &'f DVector<f64>>) -> DMatrix<f64> {
        let loads = forces
            .into_iter()
            .map(|force| self.modes.shapes.tr_mul(force));
        let loads: Vec<_> = loads.collect();
        match loads.is_empty() {
            true => DMatrix::zeros(self.system.len(), 0),
            false => DMatrix::from_columns(&loads),
        }
    }

    /// Returns `ω²` of each mode.
    fn modal_stiffness(&self) -> DVector<f64> {
        let omegas = &self.modes.angular_frequencies;
        DVector::from_iterator(omegas.len(), omegas.iter().map(|omega| omega * omega))
    }

    /// Returns the accelerations of the modes under a unit force on each, at frequencies up to half
    /// the sampling rate.
    fn receptances(&self) -> Receptances {
        let omegas = &self.modes.angular_frequencies;
        let ratios = self.modes.damping_ratios(&self.system);
        let highest = PI / self.step_s(); // half the sampling rate
        let even = (1..=FREQUENCIES).map(|k| highest * k as f64 / FREQUENCIES as f64);
        let resonances = omegas.iter().copied().filter(|omega| *omega < highest);
        let frequencies: Vec<f64> = even.chain(resonances).collect();
        let receptance = |mode: usize, at: usize| {
            let (omega, by) = (omegas[mode], frequencies[at]);
            let stiffness = Complex::new(omega * omega - by * by, 2.0 * ratios[mode] * omega * by);
            -by * by / stiffness
        };
        let all = DMatrix::from_fn(omegas.len(), frequencies.len(), receptance);
        Receptances {
            parts: [all.map(|h| h.re), all.map(|h| h.im)],
            stiffness: self.modal_stiffness(),
            frequencies,
        }
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

    /// Returns the quantity of each response channel, and a force in its place and direction (N_d).
    fn sensor_forces(&self) -> Vec<(Quantity, DVector<f64>)> {
        let channels: Vec<_> = self.channels().collect();
        let observed = self.observation_channels.iter().map(|at| &channels[*at]);
        observed
            .map(|channel| (channel.quantity(), self.force(&channel.sensed)))
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

impl Receptances {
    /// Returns `Re Σ w h hᴴ` with the weight `w` of each frequency.
    fn squares(&self, weights: &DVector<f64>) -> DMatrix<f64> {
        let modes = self.stiffness.len();
        let mut sum = DMatrix::zeros(modes, modes);
        for part in &self.parts {
            let mut weighted = part.clone();
            for (mut column, weight) in weighted.column_iter_mut().zip(weights) {
                column *= *weight;
            }
            sum.gemm(1.0, &weighted, &part.transpose(), 1.0);
        }
        sum
    }

    /// Returns the share of each frequency in the strain energy, summed over `loads` (in modes, a
    /// column for each). Without loads, the shares are equal.
    fn strain(&self, loads: &DMatrix<f64>) -> DVector<f64> {
        let [re, im] = &self.parts;
        let mut receptances = re.component_mul(re) + im.component_mul(im);
        for (mut column, omega) in receptances.column_iter_mut().zip(&self.frequencies) {
            column /= omega.powi(4); // of accelerations to displacements
        }
        let mut sum = DVector::zeros(self.frequencies.len());
        for load in loads.column_iter() {
            let energy =
                receptances.tr_mul(&self.stiffness.component_mul(&load.component_mul(&load)));
            let whole = energy.sum();
            if whole > 0.0 {
                sum += energy / whole;
            }
        }
        match sum.iter().all(|share| *share == 0.0) {
            true => sum.map(|_| 1.0),
            false => sum,
        }
    }
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
        let roof = &structure.sensor_forces()[0].1;
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
        let moving = |loads: &DVector<f64>| {
            DMatrix::from_fn(omegas.len(), frequencies.len(), |mode, at| {
                let (omega, by) = (omegas[mode], frequencies[at]);
                let damping = 2.0 * ratios[mode] * omega * by;
                -by * by * loads[mode] / Complex::new(omega * omega - by * by, damping)
            })
        };
        let mut add = |responses: DMatrix<Complex<f64>>| {
            let squares =
                &responses * responses.adjoint() / Complex::from(responses.norm_squared());
            expected += squares.map(|entry| entry.re);
        };
        let in_modes = |force: &DVector<f64>| structure.modes.shapes.tr_mul(force);
        let ground = in_modes(&structure.excitation_forces(&mass)[0]);
        let still = DMatrix::from_fn(omegas.len(), 1, |mode, _| {
            Complex::from(ground[mode] / omegas[mode].powi(2))
        });
        let motion = moving(&ground);
        // The root of the strain energy at each frequency
        let strains: Vec<f64> = (motion.column_iter().zip(&frequencies))
            .map(|(of, by)| {
                let of_mode =
                    |(at, mode): (&Complex<f64>, &f64)| (at * *mode / (by * by)).norm_sqr();
                of.iter().zip(omegas).map(of_mode).sum::<f64>().sqrt()
            })
            .collect();
        add(motion);
        add(still);
        for (_, force) in structure.sensor_forces() {
            let mut responses = moving(&in_modes(&force));
            for (mut column, strain) in responses.column_iter_mut().zip(&strains) {
                column *= Complex::from(*strain);
            }
            add(responses);
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
            residual: DMatrix::zeros(0, 0),
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

    /// Regression test: a reduced model stated a tenth of the standard deviation.
    #[test]
    fn deviations_of_a_reduced_model_agree_with_the_whole_one() {
        let mut text = TALL.replace("201", "60").replace("roof", "floor-60");
        for (number, last) in (1..=6).map(|number| (number, 10 * number)) {
            let (name, first) = (format!("part-{number}"), last - 9);
            text += &format!(
                "[[model.group]]\nname = \"{name}\"\nstoreys = [{first}, {last}]\n\
                 [[parameter]]\nname = \"{name}\"\nscales = \"stiffness\"\nof = [\"{name}\"]\n\
                 std = 0.2\n"
            );
        }
        text +=
            "[[parameter]]\nname = \"mass\"\nscales = \"mass\"\nof = [\"floor-60\"]\nstd = 0.2\n";
        for (quantity, unit, floor) in [
            ("absolute-acceleration", "m/s2", 7),
            ("relative-acceleration", "m/s2", 25),
            ("velocity", "m/s", 38),
            ("displacement", "m", 51),
        ] {
            text += &format!(
                "[[node]]\nname = \"of-{floor}\"\n[[node.channel]]\nname = \"channel-{floor}\"\n\
                 dof = \"floor-{floor}\"\nquantity = \"{quantity}\"\nunit = \"{unit}\"\n\
                 noise-std = 0.005\n"
            );
        }
        let whole = Structure::parse(&text, Path::new("tall.toml")).unwrap();
        let reduced = whole.clone();
        let basis = reduced.basis(MOST_SHAPES);
        assert!(basis.shapes.ncols() < 45, "{}", basis.shapes.ncols());
        reduced.analysis_basis.get_or_init(|| Some(basis));
        let ratios = ratios_of_deviations(&whole, &reduced);
        assert!(
            ratios.iter().all(|ratio| (ratio - 1.0).abs() < 1e-3),
            "{ratios:?}"
        );
    }

    /// Returns the standard deviations of a reduced model over those of the whole one.
    fn ratios_of_deviations(whole: &Structure, reduced: &Structure) -> Vec<f64> {
        let [whole, reduced] = [whole, reduced].map(|of| of.check(60.0, 1).identification.unwrap());
        let pairs = whole.parameters.iter().zip(&reduced.parameters);
        pairs
            .map(|(whole, reduced)| reduced.std_after / whole.std_after)
            .collect()
    }

    /// Regression tests: without the motion outside of the shapes, the deviations are too large. If
    /// its error differs between the model and the truth, the damping seems to shift the
    /// parameters.
    #[test]
    fn a_sensor_for_each_parameter_needs_the_motion_outside_of_the_shapes() {
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
        let apart: Vec<f64> = (expected.iter().zip(&found))
            .map(|(expected, found)| found - expected)
            .collect();
        assert!(apart.iter().all(|apart| apart.abs() < 0.02), "{apart:?}");
        let ratios = ratios_of_deviations(&whole, &reduced);
        assert!(
            ratios.iter().all(|ratio| (ratio - 1.0).abs() < 0.01),
            "{ratios:?}"
        );
    }
}
