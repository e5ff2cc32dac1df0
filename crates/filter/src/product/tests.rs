//! Comparison of the products with those of nalgebra.

use super::*;

fn matrix(rows: usize, columns: usize) -> DMatrix<f64> {
    DMatrix::from_fn(rows, columns, |i, j| ((3 * i + 7 * j + 1) as f64).sin())
}

fn packed(matrix: &DMatrix<f64>) -> Right {
    let mut right = Right::new(matrix.nrows(), matrix.ncols(), 1);
    right.pack(matrix);
    right
}

#[test]
fn product_agrees_with_nalgebra() {
    // Fewer rows than a register, then strips of every length, full and moved up.
    for (rows, arch) in
        (1..80).flat_map(|rows| all_instructions().into_iter().map(move |arch| (rows, arch)))
    {
        let (left, right) = (matrix(rows, 21), matrix(21, 9));
        let mut out = DMatrix::repeat(rows, 10, 7.0);
        Multiplier::with(arch).multiply_to(
            Left::new(&left),
            &packed(&right),
            Extent::Full,
            Sum::scaled(0.5),
            &mut out,
        );
        let expected = 0.5 * &left * &right;
        assert!((out.columns(0, 9) - expected).amax() < 1e-14, "{rows} rows");
        assert!(
            out.column(9).iter().all(|entry| *entry == 7.0),
            "{rows} rows"
        );
    }
}

#[test]
fn product_is_added_to_a_matrix() {
    let (left, right, start) = (matrix(37, 5), matrix(5, 37), matrix(37, 37));
    let mut out = DMatrix::zeros(37, 37);
    let sum = Sum {
        factor: -2.0,
        start: Some(Piece::new(&start)),
    };
    Multiplier::new().multiply_to(
        Left::new(&left),
        &packed(&right),
        Extent::Full,
        sum,
        &mut out,
    );
    assert!((out + 2.0 * (start + left * right)).amax() < 1e-14);
}

#[test]
fn entries_outside_the_runs_are_ignored() {
    let (left, full) = (matrix(20, 20), matrix(20, 6));
    let mut right = Right::new(20, 6, 2);
    right.pack_runs(&full, |columns, runs| {
        runs.extend([columns.start..columns.start + 2, 19..20])
    });
    let cut = DMatrix::from_fn(20, 6, |row, column| {
        let first = column / COLUMNS * COLUMNS;
        if (first..first + 2).contains(&row) || row == 19 {
            full[(row, column)]
        } else {
            0.0
        }
    });
    let mut out = DMatrix::zeros(20, 6);
    Multiplier::new().multiply_to(Left::new(&left), &right, Extent::Full, Sum::PLAIN, &mut out);
    assert!((out - left * cut).amax() < 1e-14);
}

#[test]
fn product_with_a_sparse_factor_agrees_with_nalgebra() {
    let left = matrix(20, 20);
    let sparse = DMatrix::from_fn(20, 6, |row, column| {
        if (row * column) % 5 == 1 {
            1.0 + row as f64
        } else {
            0.0
        }
    });
    let mut right = Right::new(20, 6, 10);
    right.pack_sparse(&sparse);
    let mut out = DMatrix::zeros(20, 6);
    Multiplier::new().multiply_to(Left::new(&left), &right, Extent::Full, Sum::PLAIN, &mut out);
    assert!((out - left * sparse).amax() < 1e-13);
}

#[test]
fn product_of_bands_agrees_with_nalgebra_and_is_zero_outside() {
    let band = |half: usize| {
        DMatrix::from_fn(45, 45, move |i, j| {
            if i.abs_diff(j) <= half {
                ((3 * i + 7 * j) as f64).sin()
            } else {
                0.0
            }
        })
    };
    let (left, full) = (band(4), matrix(45, 45));
    let mut right = Right::new(45, 45, 1);
    // Entries outside the band are ignored.
    right.pack_band(&full, 2);
    let cut = DMatrix::from_fn(45, 45, |i, j| {
        if i.abs_diff(j) <= 2 {
            full[(i, j)]
        } else {
            0.0
        }
    });
    let mut out = DMatrix::repeat(45, 45, 7.0);
    Multiplier::new().multiply_to(
        Left::new(&left),
        &right,
        Extent::Band(6),
        Sum::PLAIN,
        &mut out,
    );
    assert!((out - left * cut).amax() < 1e-14);
}

/// Packs two square matrices, one below the other.
fn stacked(first: &DMatrix<f64>, second: &DMatrix<f64>) -> Right {
    let n = first.nrows();
    let mut right = Right::new(2 * n, n, 2);
    let mut stack = DMatrix::zeros(2 * n, n);
    stack.rows_mut(0, n).copy_from(first);
    stack.rows_mut(n, n).copy_from(second);
    right.pack_runs(&stack, |_, runs| runs.extend([0..n, n..2 * n]));
    right
}

#[test]
fn joined_pieces_are_multiplied_into_the_requested_columns_and_rows() {
    let (first, second, by_first, by_second) = (
        matrix(21, 9),
        matrix(4, 6),
        matrix(6, 6),
        matrix(6, 6).transpose(),
    );
    let right = stacked(&by_first, &by_second);
    // The second piece contains only rows 9 to 13.
    let left = Left::joined(
        Piece::after(&first, 3),
        6,
        Piece {
            first_row: 9,
            ..Piece::new(&second)
        },
    );
    let mut out = DMatrix::repeat(4, 8, 7.0);
    Multiplier::new().run(Product {
        left,
        rows: 9..13,
        right: &right,
        first_column: 2,
        extent: Extent::Full,
        sum: Sum::PLAIN,
        store: Store::Plain {
            target: Target::new(&mut out),
            first_row: 9,
        },
    });
    let expected = first.view((9, 3), (4, 6)) * by_first + second * by_second;
    assert!((out.columns(2, 6) - expected).amax() < 1e-13);
    assert!(out.columns(0, 2).iter().all(|entry| *entry == 7.0));
}

#[test]
fn symmetric_product_has_the_same_bits_in_both_triangles() {
    for (n, arch) in (1..72).flat_map(|n| all_instructions().into_iter().map(move |arch| (n, arch)))
    {
        let factor = matrix(n, 7);
        let mut out = DMatrix::repeat(n, n, f64::NAN);
        let right = packed(&factor.transpose());
        Multiplier::with(arch).multiply_symmetric_to(
            Left::new(&factor),
            &right,
            Sum::PLAIN,
            &mut out,
        );
        assert!((&out - &factor * factor.transpose()).amax() < 1e-14, "{n}");
        assert_eq!(out, out.transpose(), "{n}");
    }
}

#[test]
fn symmetric_product_is_added_in_place_once_with_the_same_bits_in_both_triangles() {
    for (n, arch) in (1..72).flat_map(|n| all_instructions().into_iter().map(move |arch| (n, arch)))
    {
        let (factor, root) = (matrix(n, 7), matrix(n, 5));
        let mut start = &root * root.transpose();
        start.fill_upper_triangle_with_lower_triangle();
        let mut out = start.clone();
        let (right, mut diagonal) = (packed(&factor.transpose()), vec![0.0; n]);
        Multiplier::with(arch).add_symmetric_mut(
            Left::new(&factor),
            &right,
            &mut out,
            &mut diagonal,
        );
        assert!(
            (&out - (start + &factor * factor.transpose())).amax() < 1e-13,
            "{n}"
        );
        assert_eq!(out, out.transpose(), "{n}");
        assert_eq!(out.diagonal().as_slice(), diagonal, "{n}");
    }
}

#[test]
fn transposed_product_agrees_with_nalgebra() {
    let sizes = [(19, 42), (16, 8), (5, 30), (70, 10)];
    for ((rows, columns), arch) in sizes.iter().flat_map(|size| {
        all_instructions()
            .into_iter()
            .map(move |arch| (*size, arch))
    }) {
        let (left, right) = (matrix(rows, 6), matrix(6, columns));
        let mut out = DMatrix::zeros(columns, rows);
        Multiplier::with(arch).multiply_transposed_to(
            Left::new(&left),
            &packed(&right),
            Sum::PLAIN,
            &mut out,
        );
        assert!(
            (out - (left * right).transpose()).amax() < 1e-13,
            "{rows} × {columns}"
        );
    }
}

/// Checks that rows before the split are transposed, and that the other rows are stored and
/// mirrored.
#[test]
fn split_product_is_transposed_and_mirrored() {
    let (n, split) = (40, 22);
    let (left, right) = (matrix(n, 6), matrix(6, split));
    let (mut turned, mut out) = (DMatrix::zeros(split, split), DMatrix::zeros(n, n));
    for rows in strips(n) {
        let (transposed, mirrored) = (Target::new(&mut turned), Target::new(&mut out));
        Multiplier::new().run(Product {
            left: Left::new(&left),
            rows,
            right: &packed(&right),
            first_column: 0,
            extent: Extent::Full,
            sum: Sum::PLAIN,
            store: Store::Split {
                transposed,
                split,
                mirrored,
            },
        });
    }
    let expected = left * right;
    assert!((turned - expected.rows(0, split).transpose()).amax() < 1e-13);
    assert!(
        (out.view((split, 0), (n - split, split)) - expected.rows(split, n - split)).amax() < 1e-13
    );
    let above = out.view((0, split), (split, n - split)).transpose();
    assert_eq!(above, out.view((split, 0), (n - split, split)));
}
