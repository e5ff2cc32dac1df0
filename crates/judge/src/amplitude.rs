//! The hinge of an amplitude: the quantity depends on it above r0 only.
//!
//! Bearings slip, joints open and soil softens from some motion on. The regressor is therefore
//! max(r − r0, 0), where r is log10 of the amplitude. An amplitude has any unit, so that the
//! candidates of r0 follow from the commissioning.
//!
//! r0 is known only at the end of the commissioning. A day therefore keeps its amplitudes as the
//! means of ten equal parts, from weak to strong. The mean of max(r − r0, 0) over the parts is that
//! over the epochs, except for the part that contains r0.

use crate::day::Day;

/// Number of equal parts of the epochs of a day.
pub(crate) const PARTS: usize = 10;
/// Number of the candidates of r0.
pub(crate) const HINGES: usize = 9;
/// Place of the lowest and of the highest amplitude that the candidates span. The slope above r0
/// needs some days of motion above it.
const EXTREME_DAY: usize = 4;

/// Returns the mean of each of equal parts of values, in ascending order. There must be at least
/// one value.
pub(crate) fn parts(mut values: Vec<f64>) -> [f32; PARTS] {
    values.sort_by(f64::total_cmp);
    let size = values.len() as f64 / PARTS as f64;
    std::array::from_fn(|part| {
        let (from, to) = (part as f64 * size, (part + 1) as f64 * size);
        let shares = values.iter().enumerate().map(|(place, value)| {
            let (first, last) = (from.max(place as f64), to.min((place + 1) as f64));
            value * (last - first).max(0.0)
        });
        (shares.sum::<f64>() / size) as f32
    })
}

/// Returns the mean of max(r − r0, 0) over the parts of a day.
pub(crate) fn above(parts: &[f32; PARTS], hinge: f64) -> f64 {
    let above = parts.iter().map(|r| (f64::from(*r) - hinge).max(0.0));
    above.sum::<f64>() / PARTS as f64
}

/// Returns the candidates of r0 for the amplitude at a place among the amplitudes of the days, in
/// ascending order.
///
/// They divide the range of the commissioning into equal parts. The first one is nearly below all
/// amplitudes, which gives a linear effect.
pub(crate) fn hinges(days: &[Day], place: usize) -> [f64; HINGES] {
    let sorted = |part: usize| {
        let mut values: Vec<f32> = days.iter().map(|day| day.amplitudes[place][part]).collect();
        values.sort_by(f32::total_cmp);
        values
    };
    let (lowest, highest) = (sorted(0), sorted(PARTS - 1));
    let from = lowest.get(EXTREME_DAY).or(lowest.last());
    let to = highest.iter().rev().nth(EXTREME_DAY).or(highest.first());
    let (from, to) = (from.copied().unwrap_or(0.0), to.copied().unwrap_or(0.0));
    let range = f64::from((to - from).max(0.0));
    std::array::from_fn(|index| f64::from(from) + range * index as f64 / HINGES as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_keep_the_mean_of_any_number_of_epochs() {
        for count in [1_u32, 4, 10, 23, 96] {
            let values: Vec<f64> = (0..count).map(|i| f64::from(i * 7 % count)).collect();
            let mean = values.iter().sum::<f64>() / f64::from(count);
            let parts = parts(values);
            let of_parts = parts.iter().map(|r| f64::from(*r)).sum::<f64>() / PARTS as f64;
            assert!(
                (of_parts - mean).abs() < 1e-5,
                "{count}: {of_parts}, {mean}"
            );
            assert!(parts.is_sorted(), "{parts:?}");
        }
    }

    /// Two of ten epochs are strong. The mean amplitude of the day is below r0.
    #[test]
    fn strong_epochs_of_a_weak_day_count() {
        let values = vec![-2.0, 0.5, -2.0, -2.0, -2.0, 0.7, -2.0, -2.0, -2.0, -2.0];
        assert!((above(&parts(values), 0.0) - 0.12).abs() < 1e-6);
    }

    #[test]
    fn candidates_leave_the_extreme_days_out() {
        let day = |number: i64| Day {
            number,
            epochs: 1,
            y: 0.0,
            conditions: vec![0.0],
            below: Vec::new(),
            amplitudes: vec![match number {
                0..5 => [-9.0 + number as f32; PARTS],
                5..95 => [-2.0; PARTS],
                _ => [number as f32; PARTS],
            }],
        };
        let days: Vec<Day> = (0..100).map(day).collect();
        let hinges = hinges(&days, 0);
        assert_eq!(hinges[0], -5.0);
        // A ninth of the range below the fifth-strongest day, 95.
        assert!((hinges[HINGES - 1] - (95.0 - 100.0 / 9.0)).abs() < 1e-9);
    }
}
