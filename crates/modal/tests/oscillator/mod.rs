//! The exact solution of an oscillator under a force that is constant over a step.

/// Returns displacement and velocity after a step with a constant force `p` per unit mass.
pub fn exact_step([q, v]: [f64; 2], p: f64, omega: f64, damping: f64, step: f64) -> [f64; 2] {
    let rest = p / (omega * omega);
    let (a, damped) = (damping * omega, omega * (1.0 - damping * damping).sqrt());
    let (sin, cos) = (damped * step).sin_cos();
    let decay = (-a * step).exp();
    let d = q - rest;
    let b = (v + a * d) / damped;
    [
        rest + decay * (d * cos + b * sin),
        decay * (v * cos - (a * v + omega * omega * d) / damped * sin),
    ]
}
