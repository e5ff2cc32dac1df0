//! Times the dense kernels of the filter beside nalgebra (with `matrixmultiply`) and faer, in one
//! run and on one core. Prints a table.
//!
//! ```sh
//! cargo run --release --manifest-path crates/bench/libraries/Cargo.toml --bin kernels
//! ```
//!
//! The kernels are private to the filter, so this package compiles their files itself.

#[path = "../../../../filter/src"]
#[allow(dead_code, reason = "not every kernel is timed")]
mod filter {
    pub(crate) mod dense;
    pub(crate) mod product;
    pub(crate) mod small;
}

use faer::linalg::cholesky::llt::factor::{
    LltRegularization, cholesky_in_place, cholesky_in_place_scratch,
};
use faer::linalg::matmul::{matmul, triangular};
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Accum, Mat, MatMut, MatRef, Par};
use filter::product::{Extent, Left, Multiplier, Piece, Right, Sum};
use filter::{dense, small};
use nalgebra::DMatrix;
use std::hint::black_box;
use std::time::Instant;

/// Rounds in which the candidates take turns, so that other load affects all of them.
const ROUNDS: usize = 15;
/// Shortest time of a measurement, s.
const SHORTEST_S: f64 = 0.01;
/// Largest relative difference between the results of two candidates.
const AGREEMENT: f64 = 1e-10;

/// A way to compute something, which returns its result for the comparison.
type Candidate<'c> = Box<dyn FnMut() -> DMatrix<f64> + 'c>;

/// Returns the median time of one call of each candidate, s.
fn times(candidates: &mut [Candidate<'_>]) -> Vec<f64> {
    let mut rounds = vec![Vec::new(); candidates.len()];
    for _ in 0..ROUNDS {
        for (times, candidate) in rounds.iter_mut().zip(&mut *candidates) {
            let (start, mut calls) = (Instant::now(), 0);
            while start.elapsed().as_secs_f64() < SHORTEST_S {
                for _ in 0..8 {
                    black_box(candidate());
                }
                calls += 8;
            }
            times.push(start.elapsed().as_secs_f64() / f64::from(calls));
        }
    }
    rounds
        .into_iter()
        .map(|mut times| {
            times.sort_by(f64::total_cmp);
            times[ROUNDS / 2]
        })
        .collect()
}

/// Checks that ours, nalgebra and faer agree, and prints their times.
fn compare(what: &str, mut candidates: [Candidate<'_>; 3]) {
    let [ours, nalgebra, faer] = candidates.each_mut().map(|candidate| candidate());
    for (other, name) in [(nalgebra, "nalgebra"), (faer, "faer")] {
        let difference = (&ours - other).amax() / ours.amax();
        assert!(
            difference < AGREEMENT,
            "{what}: {name} differs by {difference:e}"
        );
    }
    let [ours, nalgebra, faer] = times(&mut candidates)[..] else {
        unreachable!("three candidates have three times")
    };
    let of_best = nalgebra.min(faer) / ours;
    println!(
        "| {what} | {:.0} | {:.0} | {:.0} | {of_best:.2} |",
        ours * 1e9,
        nalgebra * 1e9,
        faer * 1e9
    );
}

/// Returns entries between -1 and 1 that look irregular.
fn matrix(rows: usize, columns: usize) -> DMatrix<f64> {
    DMatrix::from_fn(rows, columns, |i, j| {
        ((7 * i + 13 * j + i * j) as f64).sin()
    })
}

/// Returns a symmetric positive definite matrix.
fn covariance(n: usize) -> DMatrix<f64> {
    let a = matrix(n, n);
    &a * a.transpose() + DMatrix::identity(n, n) * n as f64
}

fn view(a: &DMatrix<f64>) -> MatRef<'_, f64> {
    MatRef::from_column_major_slice(a.as_slice(), a.nrows(), a.ncols())
}

fn view_mut(a: &mut DMatrix<f64>) -> MatMut<'_, f64> {
    let (rows, columns) = a.shape();
    MatMut::from_column_major_slice_mut(a.as_mut_slice(), rows, columns)
}

/// Computes the lower triangle of `A B` with faer and mirrors it.
fn symmetric_product(out: &mut DMatrix<f64>, a: MatRef<'_, f64>, b: MatRef<'_, f64>) {
    use triangular::BlockStructure::{Rectangular, TriangularLower};
    triangular::matmul(
        view_mut(out),
        TriangularLower,
        Accum::Replace,
        a,
        Rectangular,
        b,
        Rectangular,
        1.0,
        Par::Seq,
    );
    out.fill_upper_triangle_with_lower_triangle();
}

fn congruence(n: usize) {
    let (a, x, arch) = (matrix(n, n), covariance(n), Multiplier::new().arch());
    let transposed = a.transpose();
    let mut ours = small::Congruence::new(&a);
    let mut out = DMatrix::zeros(n, n);
    let (mut half, mut second) = (DMatrix::zeros(n, n), DMatrix::zeros(n, n));
    let (mut of_faer, mut third) = (Mat::zeros(n, n), DMatrix::zeros(n, n));
    let (a, x) = (&a, &x);
    compare(
        &format!("`A X Aᵀ`, {n} × {n}"),
        [
            Box::new(move || {
                ours.apply_to(arch, 1.0, x, &mut out);
                out.clone()
            }),
            Box::new(move || {
                a.mul_to(x, &mut half);
                half.mul_to(&transposed, &mut second);
                second.clone()
            }),
            Box::new(move || {
                matmul(
                    &mut of_faer,
                    Accum::Replace,
                    view(a),
                    view(x),
                    1.0,
                    Par::Seq,
                );
                symmetric_product(&mut third, of_faer.as_ref(), view(a).transpose());
                third.clone()
            }),
        ],
    );
}

fn tall_product(n: usize, c: usize) {
    let (p, x, arch) = (covariance(n), matrix(n, c), Multiplier::new().arch());
    let [mut first, mut second, mut third] = [(); 3].map(|()| DMatrix::zeros(n, c));
    let (p, x) = (&p, &x);
    compare(
        &format!("`P X`, {n} × {n} and {n} × {c}"),
        [
            Box::new(move || {
                small::multiply_to(arch, p, x, &mut first);
                first.clone()
            }),
            Box::new(move || {
                p.mul_to(x, &mut second);
                second.clone()
            }),
            Box::new(move || {
                matmul(
                    view_mut(&mut third),
                    Accum::Replace,
                    view(p),
                    view(x),
                    1.0,
                    Par::Seq,
                );
                third.clone()
            }),
        ],
    );
}

fn outer_product(n: usize, c: usize) {
    let (p, v, arch) = (covariance(n), matrix(n, c), Multiplier::new().arch());
    let (p, v) = (&p, &v);
    compare(
        &format!("`P − V Vᵀ`, {n} × {n} and {n} × {c}"),
        [
            Box::new(move || {
                let mut p = p.clone();
                small::subtract_outer_mut(arch, &mut p, v);
                p
            }),
            Box::new(move || {
                let mut p = p.clone();
                p.gemm(-1.0, v, &v.transpose(), 1.0);
                p
            }),
            Box::new(move || {
                let mut p = p.clone();
                let (left, right) = (view(v), view(v).transpose());
                matmul(view_mut(&mut p), Accum::Add, left, right, -1.0, Par::Seq);
                p
            }),
        ],
    );
}

fn cholesky(m: usize) {
    let s = covariance(m);
    let s = &s;
    let scratch = cholesky_in_place_scratch::<f64>(m, Par::Seq, Default::default());
    let mut memory = faer::dyn_stack::MemBuffer::new(scratch);
    compare(
        &format!("Cholesky factor, {m} × {m}"),
        [
            Box::new(move || {
                let mut s = s.clone();
                dense::cholesky_mut(&mut s).expect("positive definite");
                s
            }),
            Box::new(move || s.clone().cholesky().expect("positive definite").unpack()),
            Box::new(move || {
                let mut s = s.clone();
                cholesky_in_place(
                    view_mut(&mut s),
                    LltRegularization::default(),
                    Par::Seq,
                    faer::dyn_stack::MemStack::new(&mut memory),
                    Default::default(),
                )
                .expect("positive definite");
                s.fill_upper_triangle(0.0, 1);
                s
            }),
        ],
    );
}

fn solve_columns(m: usize, c: usize) {
    let (factor, b) = (
        covariance(m).cholesky().expect("positive definite").l(),
        matrix(m, c),
    );
    let (factor, b) = (&factor, &b);
    compare(
        &format!("`L⁻¹ B`, {m} × {m} and {m} × {c}"),
        [
            Box::new(move || {
                let mut b = b.clone();
                dense::solve_lower_mut(factor, b.as_mut_slice());
                b
            }),
            Box::new(move || {
                let mut b = b.clone();
                factor.solve_lower_triangular_mut(&mut b);
                b
            }),
            Box::new(move || {
                let mut b = b.clone();
                solve_lower_triangular_in_place(view(factor), view_mut(&mut b), Par::Seq);
                b
            }),
        ],
    );
}

fn solve_rows(m: usize, n: usize) {
    let (factor, b) = (
        covariance(m).cholesky().expect("positive definite").l(),
        matrix(n, m),
    );
    let (factor, b, arch) = (&factor, &b, Multiplier::new().arch());
    compare(
        &format!("`B L⁻ᵀ`, {m} × {m} and {n} × {m}"),
        [
            Box::new(move || {
                let mut b = b.clone();
                dense::solve_lower_of_rows_mut(arch, factor, b.as_mut_slice());
                b
            }),
            Box::new(move || {
                let mut columns = b.transpose();
                factor.solve_lower_triangular_mut(&mut columns);
                columns.transpose()
            }),
            Box::new(move || {
                let mut b = b.clone();
                let rows = view_mut(&mut b).transpose_mut();
                solve_lower_triangular_in_place(view(factor), rows, Par::Seq);
                b
            }),
        ],
    );
}

fn gram(m: usize, n: usize) {
    let (p, v) = (covariance(n), matrix(m, n));
    let (p, v) = (&p, &v);
    compare(
        &format!("`P − Vᵀ V`, {n} × {n} and {m} × {n}"),
        [
            Box::new(move || {
                let mut p = p.clone();
                dense::subtract_gram_mut(&mut p, v);
                p
            }),
            Box::new(move || {
                let mut p = p.clone();
                p.gemm_tr(-1.0, v, v, 1.0);
                p
            }),
            Box::new(move || {
                let mut p = p.clone();
                let (left, right) = (view(v).transpose(), view(v));
                matmul(view_mut(&mut p), Accum::Add, left, right, -1.0, Par::Seq);
                p
            }),
        ],
    );
}

fn quadratic_form(n: usize, c: usize) {
    let (p, x, weights) = (covariance(n), matrix(n, c), covariance(c));
    let (p, x, weights) = (&p, &x, &weights);
    let (mut half, mut of_faer) = (DMatrix::zeros(n, c), DMatrix::zeros(n, c));
    compare(
        &format!("`P + X C Xᵀ`, {n} × {n} and {n} × {c}"),
        [
            Box::new(move || {
                let mut p = p.clone();
                dense::add_quadratic_form_mut(&mut p, x, weights, 1.0);
                p
            }),
            Box::new(move || {
                let mut p = p.clone();
                x.mul_to(weights, &mut half);
                p.gemm(1.0, &half, &x.transpose(), 1.0);
                p
            }),
            Box::new(move || {
                let mut p = p.clone();
                let half = &mut of_faer;
                matmul(
                    view_mut(half),
                    Accum::Replace,
                    view(x),
                    view(weights),
                    1.0,
                    Par::Seq,
                );
                let right = view(x).transpose();
                matmul(
                    view_mut(&mut p),
                    Accum::Add,
                    view(half),
                    right,
                    1.0,
                    Par::Seq,
                );
                p
            }),
        ],
    );
}

fn dense_product(n: usize) {
    let (left, b) = (matrix(n, n), matrix(n, n));
    let (left, b) = (&left, &b);
    let mut right = Right::new(n, n, 1);
    let [mut first, mut second, mut third] = [(); 3].map(|()| DMatrix::zeros(n, n));
    compare(
        &format!("`A B` with packing, {n} × {n}"),
        [
            Box::new(move || {
                right.pack(b);
                Multiplier::new().multiply_to(
                    Left::whole(Piece::new(left)),
                    &right,
                    Extent::Full,
                    Sum::scaled(1.0),
                    &mut first,
                );
                first.clone()
            }),
            Box::new(move || {
                left.mul_to(b, &mut second);
                second.clone()
            }),
            Box::new(move || {
                matmul(
                    view_mut(&mut third),
                    Accum::Replace,
                    view(left),
                    view(b),
                    1.0,
                    Par::Seq,
                );
                third.clone()
            }),
        ],
    );
}

fn symmetric_result(n: usize) {
    let a = matrix(n, n);
    let transposed = a.transpose();
    let (a, transposed) = (&a, &transposed);
    let mut right = Right::new(n, n, 1);
    let [mut first, mut second, mut third] = [(); 3].map(|()| DMatrix::zeros(n, n));
    compare(
        &format!("`A Aᵀ`, both triangles equal, {n} × {n}"),
        [
            Box::new(move || {
                right.pack(transposed);
                Multiplier::new().multiply_symmetric_to(
                    Left::whole(Piece::new(a)),
                    &right,
                    Sum::scaled(1.0),
                    &mut first,
                );
                first.clone()
            }),
            Box::new(move || {
                a.mul_to(transposed, &mut second);
                second.clone()
            }),
            Box::new(move || {
                symmetric_product(&mut third, view(a), view(transposed));
                third.clone()
            }),
        ],
    );
}

fn main() {
    println!("| kernel | ours ns | nalgebra ns | faer ns | faster library / ours |");
    println!("|---|---|---|---|---|");
    for n in [6, 12, 16] {
        congruence(n);
        tall_product(n, 4);
        outer_product(n, 4);
    }
    for m in [2, 4, 8, 20, 80] {
        cholesky(m);
        solve_columns(m, 4);
        solve_rows(m, 3 * m + 2);
        gram(m, m + 2);
    }
    quadratic_form(17, 1);
    quadratic_form(62, 1);
    quadratic_form(62, 3);
    for n in [32, 62, 122, 302] {
        dense_product(n);
        symmetric_result(n);
    }
}
