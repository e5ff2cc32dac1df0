//! Frequency response of the sensors to the excitation, and its derivative with respect to each
//! parameter.
//!
//! `(s I − A_u) U = B_u` and `G = H U + D` at `s = iω`, with the matrices of [`LinearForm`]. A
//! derivative with respect to a parameter is `∂G = ∂H U + W (∂A_u U + ∂B_u) + ∂D` with
//! `W = H (s I − A_u)⁻¹`. With `u = [x, v]` and `A_u = [0, A_xv; A_vx, A_vv]`, one factor of
//! `Z = s I − A_vv − A_vx A_xv / s` (N_d × N_d) gives both `U` and `W`. Time is continuous: the
//! hold of an excitation over a step, and modes above half the sampling rate, are neglected.

use crate::linear_form::LinearForm;
use crate::model::StructureModel;
use crate::structure::Structure;
use nalgebra::{Complex, DMatrix, Dyn, LU};
use rayon::prelude::*;
use std::f64::consts::PI;

/// A complex matrix.
pub(crate) type Complexes = DMatrix<Complex<f64>>;

/// Half the difference of a parameter in a difference quotient. The matrices are linear in all
/// parameters except masses.
const DIFFERENCE: f64 = 1e-4;

/// Number of equally spaced frequencies up to half the sampling rate.
const EVEN: usize = 128;

/// Distances from a resonance in half-widths: dense at the peak, wide on the flanks.
const DISTANCES: [f64; 9] = [0.0, 0.3, 0.7, 1.2, 2.0, 3.5, 6.5, 13.0, 26.0];

/// Minimum half-width of a resonance, as a share of its frequency.
const NARROWEST: f64 = 1e-4;

/// Maximum number of resolved resonances, lowest first; faster motion contains little information.
const RESOLVED: usize = 40;

/// One point of an integral over frequency.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frequency {
    /// `ω` (rad/s).
    pub(crate) omega: f64,
    /// `Δω Δt / π`; the weights add up to 1.
    pub(crate) weight: f64,
}

/// A structure with known parameters.
#[derive(Debug, Clone)]
pub(crate) struct Linearised {
    theta: Vec<f64>,
    at: LinearForm,
    /// `A_xv`, `A_vx`, their product `A_vx A_xv`, and `A_vv` (N_d × N_d).
    rate: DMatrix<f64>,
    restoring: DMatrix<f64>,
    spring: DMatrix<f64>,
    damping: Complexes,
}

/// `∂A_u`, `∂B_u`, `∂H` and `∂D` with respect to each parameter.
#[derive(Debug)]
pub(crate) struct Slopes(Vec<LinearForm>);

/// Response of the sensors to excitations `e^{iωt}` at one frequency.
#[derive(Debug, Clone)]
pub(crate) struct Response {
    /// `G` (N_0 × N_f).
    pub(crate) transfer: Complexes,
    /// `∂G` with respect to each parameter, side by side (N_0 × N_θ N_f).
    pub(crate) slopes: Complexes,
}

/// Motion of the structure at one frequency.
struct Motion {
    /// `U` (2 N_d × N_f).
    u: Parts,
    /// `W` (N_0 × 2 N_d).
    w: Parts,
}

/// Effect of a parameter on many motions.
struct Effect {
    /// `∂A_u U` (2 N_d rows) and `∂H U` (N_0 rows), the real and imaginary columns of each motion.
    pushed: DMatrix<f64>,
    shown: DMatrix<f64>,
}

/// Real and imaginary part of a complex matrix. nalgebra has fast products of real matrices only.
struct Parts {
    re: DMatrix<f64>,
    im: DMatrix<f64>,
}

impl Linearised {
    /// Linearises `structure` at `theta` (ratios to nominal).
    pub(crate) fn new(structure: &Structure, theta: &[f64]) -> Self {
        let basis = structure.analysis_basis();
        let at = LinearForm::moving_in(&mut structure.model(), theta, basis);
        let free = at.system.nrows() / 2;
        let block = |row, column| at.system.view((row, column), (free, free)).into_owned();
        let (rate, restoring, damping) =
            (block(0, free), block(free, 0), complex(&block(free, free)));
        Self {
            spring: &restoring * &rate,
            rate,
            restoring,
            damping,
            theta: theta.to_vec(),
            at,
        }
    }

    /// Returns the derivatives of the matrices of `structure`, from which the form was made.
    pub(crate) fn slopes(&self, structure: &Structure) -> Slopes {
        let basis = structure.analysis_basis();
        let slope = |model: &mut StructureModel, parameter: usize| {
            let mut moved = |by: f64| {
                let mut theta = self.theta.clone();
                theta[parameter] += by;
                LinearForm::moving_in(model, &theta, basis)
            };
            difference(moved(DIFFERENCE), &moved(-DIFFERENCE))
        };
        let parameters = (0..self.theta.len()).into_par_iter();
        Slopes(parameters.map_init(|| structure.model(), slope).collect())
    }

    /// Returns `G` at `omega` (rad/s); `None` at the resonance of an undamped mode.
    pub(crate) fn transfer(&self, omega: f64) -> Option<Complexes> {
        let motion = Solver::new(self, omega)?.solve(&complex(&self.at.input))?;
        Some(self.seen(&motion))
    }

    /// Returns `H U + D`.
    fn seen(&self, motion: &Complexes) -> Complexes {
        product(&self.at.observation, motion) + complex(&self.at.direct)
    }

    /// Returns `G` and its derivatives at some frequencies; `None` at the resonance of an undamped
    /// mode.
    pub(crate) fn responses(
        &self,
        Slopes(slopes): &Slopes,
        frequencies: &[Frequency],
    ) -> Option<Vec<Response>> {
        let input = complex(&self.at.input);
        let at_frequency = |frequency: &Frequency| {
            let solver = Solver::new(self, frequency.omega)?;
            let u = solver.solve(&input)?;
            let motion = Motion {
                u: Parts::of(&u),
                w: Parts::of(&solver.solve_from_left(&self.at.observation)?),
            };
            Some((motion, self.seen(&u)))
        };
        let found: Option<Vec<_>> = frequencies.par_iter().map(at_frequency).collect();
        let found = found?;
        // A product with all motions at once: reading `∂A_u` takes longer than one product.
        let all: Vec<_> = found
            .iter()
            .flat_map(|(Motion { u, .. }, _)| u.re.column_iter().chain(u.im.column_iter()))
            .collect();
        let all = DMatrix::from_columns(&all);
        let effect = |slope: &LinearForm| Effect {
            pushed: &slope.system * &all,
            shown: &slope.observation * &all,
        };
        let effects: Vec<Effect> = slopes.par_iter().map(effect).collect();
        let response = |(index, (motion, transfer)): (usize, (Motion, Complexes))| Response {
            slopes: slopes_of_transfer(slopes, &motion.w, &effects, index),
            transfer,
        };
        Some(found.into_par_iter().enumerate().map(response).collect())
    }
}

/// Returns `∂G` with respect to all parameters for the motion number `index`, whose `W` is `w`.
fn slopes_of_transfer(
    slopes: &[LinearForm],
    w: &Parts,
    effects: &[Effect],
    index: usize,
) -> Complexes {
    let inputs = slopes.first().map_or(0, |slope| slope.input.ncols());
    let [re, im] = [2 * index * inputs, (2 * index + 1) * inputs];
    let width = inputs * slopes.len();
    let mut pushed = Parts::zeros(w.re.ncols(), width);
    let mut shown = Parts::zeros(w.re.nrows(), width);
    for (parameter, (effect, slope)) in effects.iter().zip(slopes).enumerate() {
        let own = |of: &DMatrix<f64>, column: usize| of.columns(column, inputs).into_owned();
        let columns = [
            (&mut pushed.re, own(&effect.pushed, re) + &slope.input),
            (&mut pushed.im, own(&effect.pushed, im)),
            (&mut shown.re, own(&effect.shown, re) + &slope.direct),
            (&mut shown.im, own(&effect.shown, im)),
        ];
        for (all, found) in columns {
            all.columns_mut(parameter * inputs, inputs)
                .copy_from(&found);
        }
    }
    let seen = w.times(&pushed);
    (seen.re + shown.re).zip_map(&(seen.im + shown.im), Complex::new)
}

impl Parts {
    fn zeros(rows: usize, columns: usize) -> Self {
        Self {
            re: DMatrix::zeros(rows, columns),
            im: DMatrix::zeros(rows, columns),
        }
    }

    fn of(x: &Complexes) -> Self {
        Self {
            re: x.map(|entry| entry.re),
            im: x.map(|entry| entry.im),
        }
    }

    fn times(&self, other: &Self) -> Self {
        let (mut re, mut im) = (&self.re * &other.re, &self.re * &other.im);
        re.gemm(-1.0, &self.im, &other.im, 1.0);
        im.gemm(1.0, &self.im, &other.re, 1.0);
        Self { re, im }
    }
}

/// Returns the product of two complex matrices, computed as four real products.
pub(crate) fn complex_product(a: &Complexes, b: &Complexes) -> Complexes {
    let Parts { re, im } = Parts::of(a).times(&Parts::of(b));
    re.zip_map(&im, Complex::new)
}

/// Returns the difference of two forms, divided by their distance in a parameter.
fn difference(up: LinearForm, down: &LinearForm) -> LinearForm {
    let by = |up: DMatrix<f64>, down: &DMatrix<f64>| (up - down) / (2.0 * DIFFERENCE);
    LinearForm {
        system: by(up.system, &down.system),
        input: by(up.input, &down.input),
        observation: by(up.observation, &down.observation),
        direct: by(up.direct, &down.direct),
    }
}

fn complex(matrix: &DMatrix<f64>) -> Complexes {
    matrix.map(|entry| Complex::new(entry, 0.0))
}

/// Returns the product of a real and a complex matrix, computed as two real products.
fn product(real: &DMatrix<f64>, x: &Complexes) -> Complexes {
    let Parts { re, im } = Parts::of(x);
    (real * re).zip_map(&(real * im), Complex::new)
}

/// `(s I − A_u)⁻¹` at one frequency.
struct Solver<'l> {
    s: Complex<f64>,
    of: &'l Linearised,
    /// Factor of `Z`.
    factor: LU<Complex<f64>, Dyn, Dyn>,
}

impl<'l> Solver<'l> {
    fn new(linearised: &'l Linearised, omega: f64) -> Option<Self> {
        let s = Complex::new(0.0, omega);
        let mut z = linearised
            .spring
            .zip_map(&linearised.damping, |spring, damping| {
                -s.inv() * spring - damping
            });
        (0..z.nrows()).for_each(|row| z[(row, row)] += s);
        let factor = z.lu();
        factor.is_invertible().then_some(Self {
            s,
            of: linearised,
            factor,
        })
    }

    /// Returns `(s I − A_u)⁻¹ X` for columns `X` (2 N_d).
    fn solve(&self, columns: &Complexes) -> Option<Complexes> {
        let (free, width) = (columns.nrows() / 2, columns.ncols());
        let upper = columns.rows(0, free) * self.s.inv();
        let v = self
            .factor
            .solve(&(columns.rows(free, free) + product(&self.of.restoring, &upper)))?;
        let x = upper + product(&self.of.rate, &v) * self.s.inv();
        let mut out = Complexes::zeros(2 * free, width);
        out.rows_mut(0, free).copy_from(&x);
        out.rows_mut(free, free).copy_from(&v);
        Some(out)
    }

    /// Returns `X (s I − A_u)⁻¹` for rows `X` (2 N_d).
    fn solve_from_left(&self, rows: &DMatrix<f64>) -> Option<Complexes> {
        let free = rows.ncols() / 2;
        let of_x = complex(&rows.columns(0, free).into_owned());
        let of_v = rows.columns(free, free).into_owned();
        // Y Z = X_x A_xv / s + X_v, so that the result is [(X_x + Y A_vx) / s, Y].
        let through = complex(&(rows.columns(0, free) * &self.of.rate)) * self.s.inv();
        let y = self.over_z(&(through + complex(&of_v)))?;
        let mut out = Complexes::zeros(rows.nrows(), 2 * free);
        let x = of_x + product(&self.of.restoring.transpose(), &y.transpose()).transpose();
        out.columns_mut(0, free).copy_from(&(x * self.s.inv()));
        out.columns_mut(free, free).copy_from(&y);
        Some(out)
    }

    /// Returns `X Z⁻¹`, from `P Z = L U`.
    fn over_z(&self, x: &Complexes) -> Option<Complexes> {
        let mut y = self.factor.u().tr_solve_upper_triangular(&x.transpose())?;
        y = self.factor.l().tr_solve_lower_triangular(&y)?;
        self.factor.p().inv_permute_rows(&mut y);
        Some(y.transpose())
    }
}

/// Returns frequencies up to half the sampling rate that resolve the resonances of all `forms`.
pub(crate) fn frequencies(forms: &[&Linearised], step_s: f64) -> Vec<Frequency> {
    let highest = PI / step_s;
    let mut omegas: Vec<f64> = (0..EVEN)
        .map(|index| (index as f64 + 0.5) / EVEN as f64 * highest)
        .collect();
    for form in forms {
        let mut poles: Vec<Complex<f64>> = form
            .at
            .system
            .complex_eigenvalues()
            .iter()
            .copied()
            .collect();
        poles.retain(|pole| pole.im > 0.0 && pole.im < highest);
        poles.sort_by(|a, b| a.im.total_cmp(&b.im));
        for pole in poles.iter().take(RESOLVED) {
            let half_width = pole.re.abs().max(NARROWEST * pole.im);
            let sides = DISTANCES
                .iter()
                .flat_map(|distance| [-distance * half_width, distance * half_width]);
            omegas.extend(
                sides
                    .map(|side| pole.im + side)
                    .filter(|omega| *omega > 0.0 && *omega < highest),
            );
        }
    }
    omegas.sort_by(f64::total_cmp);
    omegas.dedup();
    // Each frequency represents the band between the midpoints to its neighbours.
    let middle = |index: usize| match (
        index.checked_sub(1).and_then(|before| omegas.get(before)),
        omegas.get(index),
    ) {
        (Some(before), Some(at)) => 0.5 * (before + at),
        (None, _) => 0.0,
        (Some(_), None) => highest,
    };
    let weigh = |index: usize| Frequency {
        omega: omegas[index],
        weight: (middle(index + 1) - middle(index)) / highest,
    };
    (0..omegas.len()).map(weigh).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn slopes_of_the_transfer_are_the_limit_of_differences() {
        let text = include_str!("../../../docs/examples/demo.toml");
        let structure = Structure::parse(text, Path::new("example.toml")).unwrap();
        let theta = structure.prior_means();
        let linearised = Linearised::new(&structure, &theta);
        let some = frequencies(&[&linearised], structure.step_s());
        let slopes = linearised.slopes(&structure);
        let responses = linearised.responses(&slopes, &some).unwrap();
        for parameter in 0..theta.len() {
            let [up, down] = [DIFFERENCE, -DIFFERENCE].map(|by| {
                let mut theta = theta.clone();
                theta[parameter] += by;
                Linearised::new(&structure, &theta)
            });
            for (index, frequency) in some.iter().enumerate() {
                let of = |at: &Linearised| at.transfer(frequency.omega).unwrap();
                assert_eq!(responses[index].transfer, of(&linearised));
                let expected = (of(&up) - of(&down)) / Complex::new(2.0 * DIFFERENCE, 0.0);
                let inputs = responses[index].transfer.ncols();
                let slopes = &responses[index].slopes;
                let found = slopes.columns(parameter * inputs, inputs);
                // The last parameter may have no effect at all.
                let scale = expected.norm() + 1e-3 * responses[index].transfer.norm();
                assert!(
                    (found - &expected).norm() < 1e-4 * scale,
                    "parameter {parameter} at {} rad/s: {found} for {expected}",
                    frequency.omega
                );
            }
        }
    }
}
