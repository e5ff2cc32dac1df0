//! Three-pier bridge with 59 degrees of freedom: a plane Euler-Bernoulli frame with consistent mass
//! (ch2 §4.4).

use nalgebra::{DMatrix, DVector, Matrix6};
use spandrel_filter::{ObservationModel, ProcessModel};

const DENSITY: f64 = 3780.0;
const MODULUS: f64 = 2e9;
const DECK: (f64, f64) = (1.56, 4.02);
/// Solid circle: I = A²/4π.
const PIER: (f64, f64) = (1.57, 1.57 * 1.57 / (4.0 * std::f64::consts::PI));
/// α (1/s) and β (s).
const RAYLEIGH: [f64; 2] = [0.063, 0.006];
pub const GROUPS: usize = 7;

/// Returns the nodes: deck nodes 1 to 17 every 16 m, and piers below 5, 9 and 13, each with a
/// middle node and a foot.
fn nodes() -> Vec<(f64, f64)> {
    let mut nodes: Vec<(f64, f64)> = (0..17).map(|j| (16.0 * f64::from(j), 0.0)).collect();
    for x in [64.0, 128.0, 192.0] {
        nodes.extend([(x, -8.0), (x, -16.0)]);
    }
    nodes
}

/// Returns the elements: two nodes (from 1), group (from 0), section.
fn elements() -> Vec<(usize, usize, usize, (f64, f64))> {
    let mut elements: Vec<_> = (1..=16).map(|j| (j, j + 1, (j - 1) / 4, DECK)).collect();
    for (pier, (deck, middle, foot)) in [(5, 18, 19), (9, 20, 21), (13, 22, 23)]
        .into_iter()
        .enumerate()
    {
        elements.extend([
            (deck, middle, 4 + pier, PIER),
            (middle, foot, 4 + pier, PIER),
        ]);
    }
    elements
}

/// Returns stiffness and consistent mass of an element in global coordinates.
fn element_matrices(
    from: (f64, f64),
    to: (f64, f64),
    (a, i): (f64, f64),
) -> (Matrix6<f64>, Matrix6<f64>) {
    let (dx, dy) = (to.0 - from.0, to.1 - from.1);
    let l = dx.hypot(dy);
    let (c, s) = (dx / l, dy / l);
    let (e, rho) = (MODULUS, DENSITY);
    let (k1, k2, k3, k4, k5) = (
        e * a / l,
        12.0 * e * i / l.powi(3),
        6.0 * e * i / l.powi(2),
        4.0 * e * i / l,
        2.0 * e * i / l,
    );
    #[rustfmt::skip]
    let k = Matrix6::new(
        k1, 0.0, 0.0, -k1, 0.0, 0.0,
        0.0, k2, k3, 0.0, -k2, k3,
        0.0, k3, k4, 0.0, -k3, k5,
        -k1, 0.0, 0.0, k1, 0.0, 0.0,
        0.0, -k2, -k3, 0.0, k2, -k3,
        0.0, k3, k5, 0.0, -k3, k4,
    );
    #[rustfmt::skip]
    let m = Matrix6::new(
        140.0, 0.0, 0.0, 70.0, 0.0, 0.0,
        0.0, 156.0, 22.0 * l, 0.0, 54.0, -13.0 * l,
        0.0, 22.0 * l, 4.0 * l * l, 0.0, 13.0 * l, -3.0 * l * l,
        70.0, 0.0, 0.0, 140.0, 0.0, 0.0,
        0.0, 54.0, 13.0 * l, 0.0, 156.0, -22.0 * l,
        0.0, -13.0 * l, -3.0 * l * l, 0.0, -22.0 * l, 4.0 * l * l,
    ) * (rho * a * l / 420.0);
    let mut local_from_global = Matrix6::zeros();
    for end in [0, 3] {
        local_from_global[(end, end)] = c;
        local_from_global[(end, end + 1)] = s;
        local_from_global[(end + 1, end)] = -s;
        local_from_global[(end + 1, end + 1)] = c;
        local_from_global[(end + 2, end + 2)] = 1.0;
    }
    let turn = |matrix: Matrix6<f64>| local_from_global.transpose() * matrix * local_from_global;
    (turn(k), turn(m))
}

/// State y = [x (59), ẋ (59), θ (7), α and β relative to their true values]; absolute accelerations
/// are observed.
#[derive(Debug, Clone)]
pub struct Bridge {
    pub mass: DMatrix<f64>,
    pub stiffness: DMatrix<f64>,
    /// M⁻¹ K of each group.
    groups: Vec<DMatrix<f64>>,
    /// Displacements caused by a unit ground displacement, horizontal and vertical.
    influence: [DVector<f64>; 2],
    sensed: Vec<usize>,
    process: Point,
    observed: Point,
}

/// A linearisation point: M⁻¹K(θ) and the derivatives with respect to the parameters.
#[derive(Debug, Clone)]
struct Point {
    velocity: DVector<f64>,
    stiffness: DMatrix<f64>,
    /// ∂ẍ/∂(θ, α, β) (59 × 9).
    by_parameter: DMatrix<f64>,
    acceleration: DVector<f64>,
    alpha: f64,
    beta: f64,
    largest_factor: f64,
}

impl Bridge {
    pub fn new() -> Self {
        let nodes = nodes();
        let pinned = [1, 17, 19, 21, 23];
        let mut number = vec![[None; 3]; nodes.len() + 1];
        let mut free = 0;
        for (node, dofs) in number.iter_mut().enumerate().skip(1) {
            for (direction, dof) in dofs.iter_mut().enumerate() {
                if direction == 2 || !pinned.contains(&node) {
                    *dof = Some(free);
                    free += 1;
                }
            }
        }
        let mut mass = DMatrix::zeros(free, free);
        let mut groups = vec![DMatrix::zeros(free, free); GROUPS];
        for (first, second, group, section) in elements() {
            let (k, m) = element_matrices(nodes[first - 1], nodes[second - 1], section);
            let dofs: Vec<_> = number[first]
                .iter()
                .chain(&number[second])
                .copied()
                .collect();
            for (i, row) in dofs.iter().enumerate() {
                for (j, column) in dofs.iter().enumerate() {
                    if let (Some(row), Some(column)) = (row, column) {
                        groups[group][(*row, *column)] += k[(i, j)];
                        mass[(*row, *column)] += m[(i, j)];
                    }
                }
            }
        }
        let stiffness = groups
            .iter()
            .fold(DMatrix::zeros(free, free), |sum, k| sum + k);
        let factor = nalgebra::Cholesky::new(mass.clone()).unwrap();
        let influence = [0, 1].map(|direction| {
            DVector::from_fn(free, |dof, _| {
                f64::from(u8::from(
                    number.iter().any(|dofs| dofs[direction] == Some(dof)),
                ))
            })
        });
        let horizontal = [5, 13, 20, 22].map(|node: usize| (node, 0));
        let vertical = [9, 18, 20, 22].map(|node: usize| (node, 1));
        let sensed = horizontal
            .iter()
            .chain(&vertical)
            .map(|(node, d)| number[*node][*d].unwrap())
            .collect();
        let point = Point {
            velocity: DVector::zeros(free),
            stiffness: DMatrix::zeros(free, free),
            by_parameter: DMatrix::zeros(free, GROUPS + 2),
            acceleration: DVector::zeros(free),
            alpha: 0.0,
            beta: 0.0,
            largest_factor: 1.0,
        };
        Self {
            groups: groups.iter().map(|k| factor.solve(k)).collect(),
            mass,
            stiffness,
            influence,
            sensed,
            process: point.clone(),
            observed: point,
        }
    }

    pub fn freedoms(&self) -> usize {
        self.mass.nrows()
    }

    /// Returns the continuous system of the nominal bridge: A_u, B_u and the rows of H.
    pub fn nominal(&self) -> (DMatrix<f64>, DMatrix<f64>, DMatrix<f64>) {
        let n = self.freedoms();
        let stiffness = self
            .groups
            .iter()
            .fold(DMatrix::zeros(n, n), |sum, k| sum + k);
        let damping = DMatrix::identity(n, n) * RAYLEIGH[0] + &stiffness * RAYLEIGH[1];
        let mut system = DMatrix::zeros(2 * n, 2 * n);
        system.view_mut((0, n), (n, n)).fill_with_identity();
        system.view_mut((n, 0), (n, n)).copy_from(&-stiffness);
        system.view_mut((n, n), (n, n)).copy_from(&-damping);
        let mut input = DMatrix::zeros(2 * n, 2);
        for direction in 0..2 {
            input
                .view_mut((n, direction), (n, 1))
                .copy_from(&-&self.influence[direction]);
        }
        let rows = DMatrix::from_fn(self.sensed.len(), 2 * n, |row, j| {
            system[(n + self.sensed[row], j)]
        });
        (system, input, rows)
    }

    fn point(&self, state: &[f64]) -> Point {
        let n = self.freedoms();
        let x = DVector::from_column_slice(&state[..n]);
        let v = DVector::from_column_slice(&state[n..2 * n]);
        let (theta, other) = state[2 * n..].split_at(GROUPS);
        let (alpha, beta) = (other[0] * RAYLEIGH[0], other[1] * RAYLEIGH[1]);
        let strain = &x + beta * &v;
        let mut stiffness = DMatrix::zeros(n, n);
        let mut by_parameter = DMatrix::zeros(n, GROUPS + 2);
        for (group, matrix) in self.groups.iter().enumerate() {
            stiffness += matrix * theta[group];
            by_parameter.set_column(group, &-(matrix * &strain));
        }
        by_parameter.set_column(GROUPS, &(-RAYLEIGH[0] * &v));
        by_parameter.set_column(GROUPS + 1, &(-RAYLEIGH[1] * (&stiffness * &v)));
        let acceleration = -(&stiffness * &strain) - alpha * &v;
        let largest_factor = theta
            .iter()
            .fold(0.0_f64, |largest, factor| largest.max(*factor));
        Point {
            velocity: v,
            stiffness,
            by_parameter,
            acceleration,
            alpha,
            beta,
            largest_factor,
        }
    }

    fn accelerate(point: &Point, columns: &DMatrix<f64>) -> DMatrix<f64> {
        let n = point.velocity.len();
        let strain = columns.rows(0, n) + point.beta * columns.rows(n, n);
        let elastic = &point.stiffness * strain;
        &point.by_parameter * columns.rows(2 * n, GROUPS + 2)
            - elastic
            - point.alpha * columns.rows(n, n)
    }
}

impl ProcessModel for Bridge {
    fn state_len(&self) -> usize {
        2 * self.freedoms() + GROUPS + 2
    }
    fn parameter_len(&self) -> usize {
        GROUPS + 2
    }
    fn excitation_len(&self) -> usize {
        2
    }
    fn linearise_process(&mut self, state: &[f64], _: &[f64]) {
        self.process = self.point(state);
    }
    fn derivative(&self, out: &mut [f64]) {
        let n = self.freedoms();
        out.fill(0.0);
        out[..n].copy_from_slice(self.process.velocity.as_slice());
        out[n..2 * n].copy_from_slice(self.process.acceleration.as_slice());
    }
    fn jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let n = self.freedoms();
        out.fill(0.0);
        out.rows_mut(0, n).copy_from(&columns.rows(n, n));
        out.rows_mut(n, n)
            .copy_from(&Self::accelerate(&self.process, columns));
    }
    fn excitation_matrix(&self, out: &mut DMatrix<f64>) {
        let n = self.freedoms();
        out.fill(0.0);
        for direction in 0..2 {
            out.view_mut((n, direction), (n, 1))
                .copy_from(&-&self.influence[direction]);
        }
    }
    fn rate_bound(&self) -> f64 {
        // ω_max = 228.3 rad/s as designed. Up to βω = 2, a mode is not overdamped, and |λ| = ω.
        let omega = 228.3 * self.process.largest_factor.max(0.0).sqrt();
        if self.process.beta * omega < 2.0 {
            omega
        } else {
            self.process.beta * omega * omega
        }
    }
}

impl ObservationModel for Bridge {
    fn observation_len(&self) -> usize {
        self.sensed.len()
    }
    fn linearise_observation(&mut self, state: &[f64], _: &[f64]) {
        self.observed = self.point(state);
    }
    fn observe(&self, out: &mut [f64]) {
        for (value, dof) in out.iter_mut().zip(&self.sensed) {
            *value = self.observed.acceleration[*dof];
        }
    }
    fn observation_jacobian_mul(&self, columns: &DMatrix<f64>, out: &mut DMatrix<f64>) {
        let accelerations = Self::accelerate(&self.observed, columns);
        for (row, dof) in self.sensed.iter().enumerate() {
            out.row_mut(row).copy_from(&accelerations.row(*dof));
        }
    }
    fn feedthrough(&self) -> Option<&DMatrix<f64>> {
        None
    }
}
