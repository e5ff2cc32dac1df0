//! Accuracy with which a changing level or parameter is tracked.

use crate::scene::Course;
use crate::statistics::Mean;

/// Returns the mean ratio of estimate to truth in a window, the share of the window in which ± 3 sd
/// contain the truth, and the mean relative deviation.
pub(crate) fn agreement(level: &Course, from_s: f64, to_s: f64) -> (f64, f64, f64) {
    let (mut ratio, mut inside, mut relative_std) =
        (Mean::default(), Mean::default(), Mean::default());
    for [_, mean, std, truth] in level
        .points
        .iter()
        .filter(|point| (from_s..to_s).contains(&point[0]))
    {
        ratio.take(mean / truth);
        inside.take(f64::from(u8::from((mean - truth).abs() <= 3.0 * std)));
        relative_std.take(std / mean);
    }
    (ratio.value(), inside.value(), relative_std.value())
}

/// Returns the value and time of the largest running mean over 2 s after a time.
pub(crate) fn peak(level: &Course, after_s: f64) -> (f64, f64) {
    let end = level.points.last().map_or(0.0, |point| point[0]) - 1.0;
    // Integer tenths of a second add up without rounding.
    let tenths = (10.0 * after_s).round() as i64..(10.0 * end).ceil() as i64;
    let means = tenths
        .step_by(2)
        .map(|tenth| tenth as f64 / 10.0)
        .map(|time_s| (level.mean(time_s - 1.0, time_s + 1.0), time_s));
    means.fold((0.0, after_s), |largest, mean| {
        if mean.0 > largest.0 { mean } else { largest }
    })
}

/// Returns the delay of the truth (s) with which the estimate correlates best.
pub(crate) fn lag(level: &Course, from_s: f64) -> f64 {
    let points: Vec<&[f64; 4]> = level.points.iter().collect();
    let step_s = points[1][0] - points[0][0];
    let start = points.partition_point(|point| point[0] < from_s);
    let correlation = |delay: usize| {
        let pairs: Vec<(f64, f64)> = (start..points.len())
            .map(|i| (points[i][1], points[i - delay][3]))
            .collect();
        let n = pairs.len() as f64;
        let (a, b) = pairs
            .iter()
            .fold((0.0, 0.0), |(a, b), (x, y)| (a + x / n, b + y / n));
        let of = |f: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(f).sum::<f64>();
        of(&|(x, y)| (x - a) * (y - b))
            / (of(&|(x, _)| (x - a).powi(2)) * of(&|(_, y)| (y - b).powi(2))).sqrt()
    };
    let delays = (0..(15.0 / step_s) as usize).step_by((0.1 / step_s).max(1.0) as usize);
    let best = delays
        .map(|delay| (delay, correlation(delay)))
        .max_by(|a, b| a.1.total_cmp(&b.1));
    best.map_or(f64::NAN, |(delay, _)| delay as f64 * step_s)
}
