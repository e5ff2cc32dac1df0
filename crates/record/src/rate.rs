//! The sampling rate that times tell.

/// Relative difference up to which the inverse of a step is meant to be a whole number of Hz.
const WHOLE_HZ: f64 = 1e-9;

/// Sampling rate in Hz of a step in s: 50 kHz of 2e-5 s, and not what rounding makes of it.
pub(crate) fn rate_from_step(step_s: f64) -> f64 {
    let rate_hz = 1.0 / step_s;
    let whole_hz = rate_hz.round();
    if (rate_hz - whole_hz).abs() <= WHOLE_HZ * rate_hz {
        whole_hz
    } else {
        rate_hz
    }
}

/// Sampling rate in Hz from times in ns; `None` if there are fewer than two, or they do not increase.
///
/// The median step tells what is a gap (more than half a step off); the mean of the others is the step. The median alone
/// would not do: times rounded to milliseconds at 120 Hz have the steps 8, 8, 9 ms, and a median of 125 Hz.
pub(crate) fn rate_from_times(times_ns: &[i64]) -> Option<f64> {
    let mut steps_ns: Vec<i64> = times_ns
        .windows(2)
        .map(|pair| pair[1].saturating_sub(pair[0]))
        .collect();
    steps_ns.sort_unstable();
    let median_ns = *steps_ns.get(steps_ns.len() / 2)?;
    let regular = steps_ns
        .iter()
        .filter(|step_ns| (**step_ns - median_ns).abs() <= median_ns / 2);
    let (count, total_ns) = regular.fold((0_u32, 0_i64), |(count, total), step| {
        (count + 1, total.saturating_add(*step))
    });
    (total_ns > 0).then(|| 1e9 * f64::from(count) / total_ns as f64)
}
