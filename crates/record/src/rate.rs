//! Determines sampling rates from time steps.

/// Relative tolerance within which a rate is rounded to a whole number of Hz.
const WHOLE_HZ: f64 = 1e-9;

/// Relative tolerance within which two sampling rates are equal. Clocks within one recorder differ
/// by less.
pub(crate) const SAME_RATE: f64 = 1e-4;

/// Returns the sampling rate in Hz for a step in s. Removes rounding errors: a step of 2e-5 s gives
/// exactly 50 kHz.
pub(crate) fn rate_from_step(step_s: f64) -> f64 {
    let rate_hz = 1.0 / step_s;
    let whole_hz = rate_hz.round();
    if (rate_hz - whole_hz).abs() <= WHOLE_HZ * rate_hz {
        whole_hz
    } else {
        rate_hz
    }
}

/// Returns the sampling rate in Hz for times in ns.
///
/// Steps that differ from the median by more than half of it are gaps. The result is based on the
/// mean of the other steps. The median alone would be wrong: times at 120 Hz rounded to
/// milliseconds have steps of 8, 8 and 9 ms, and a median of 125 Hz.
///
/// Returns `None` if there are fewer than two times, or if they do not increase.
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
