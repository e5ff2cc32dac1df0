//! Reads the optional tables `[filter]`, `[band-limit]` and `[ingest]`.

use crate::filter_plan::{Annealing, FilterPlan};
use crate::section::{Allowed, Section};
use crate::settings::{BandLimit, IngestSettings, ParticleKeys};
use spandrel_filter::{ImportanceDensity, InputHold, NoiseRule};

const NOISE_RULES: [(&str, NoiseRule); 4] = [
    ("fisher", NoiseRule::Fisher),
    ("published", NoiseRule::Published),
    ("half-or-double", NoiseRule::HalfOrDouble),
    ("fixed", NoiseRule::Fixed),
];

const INPUT_HOLDS: [(&str, InputHold); 2] = [
    ("zero-order", InputHold::Zero),
    ("first-order", InputHold::First),
];

/// Kind of filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Kalman,
    Particle,
}

const KINDS: [(&str, Kind); 2] = [("kalman", Kind::Kalman), ("particle", Kind::Particle)];

const DENSITIES: [(&str, ImportanceDensity); 2] = [
    ("optimal", ImportanceDensity::Optimal),
    ("prior", ImportanceDensity::Prior),
];

/// Keys of `[filter]` that apply only to particles.
const OF_PARTICLES: [&str; 4] = ["particles", "density", "drift", "warm-up-s"];

/// Maximum number of particles, limited by memory.
const MOST_PARTICLES: usize = 10_000_000;

/// Minimum half-life in steps; a shorter half-life forgets the data before they contain
/// information.
const LEAST_HALF_LIFE_STEPS: f64 = 10.0;

/// Quantities that the filter estimates besides the noise levels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Follows {
    /// Motion and parameters.
    Parameters,
    /// The motion alone: a linear filter for a linear structure.
    MotionAlone,
}

/// Measured quantities.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Measures {
    /// An excitation. Its record is interpolated between samples.
    Excitation,
    /// Responses only. An unmeasured excitation is white noise and held over a step.
    ResponsesAlone,
}

/// What the filter of a structure must do.
#[derive(Debug, Clone, Copy)]
pub(super) struct FilterTask {
    pub(super) follows: Follows,
    pub(super) measures: Measures,
}

/// Reads `[filter]`; a missing table is equivalent to an empty one.
///
/// `rate_hz` is the sampling rate of the structure.
pub(super) fn read_filter(
    section: Option<Section<'_>>,
    rate_hz: Option<f64>,
    task: FilterTask,
) -> FilterPlan {
    let mut plan = FilterPlan::default();
    if task.measures == Measures::ResponsesAlone {
        plan.input_hold = InputHold::Zero;
    }
    if task.follows == Follows::MotionAlone {
        plan.annealing.amount = 0.0; // a linear filter cannot lock in
    }
    let Some(mut section) = section else {
        return plan;
    };
    plan.half_life_s =
        read_half_life(&mut section, "half-life-s", rate_hz).unwrap_or(plan.half_life_s);
    if let Some(rule) = section.choice("noise-rule", &NOISE_RULES) {
        plan.noise_rule = rule.into_inner();
    }
    // One memory for both, unless the file specifies two, as in the source.
    plan.noise_half_life_s =
        read_half_life(&mut section, "noise-half-life-s", rate_hz).unwrap_or(plan.half_life_s);
    plan.noise_prior_std =
        section.number_or("noise-prior-std", Allowed::POSITIVE, plan.noise_prior_std);
    plan.noise_floor = section.number_or("noise-floor", Allowed::NOT_NEGATIVE, plan.noise_floor);
    plan.annealing = Annealing {
        amount: section.number_or(
            "annealing-amount",
            Allowed::NOT_NEGATIVE,
            plan.annealing.amount,
        ),
        time_s: section.number_or("annealing-time-s", Allowed::POSITIVE, plan.annealing.time_s),
    };
    plan.variance_bound =
        section.number_or("variance-bound", Allowed::POSITIVE, plan.variance_bound);
    if let Some(hold) = section.choice("input-hold", &INPUT_HOLDS) {
        plan.input_hold = hold.into_inner();
    }
    plan.displacement_std_m = section.number_or(
        "displacement-std-m",
        Allowed::POSITIVE,
        plan.displacement_std_m,
    );
    plan.velocity_std_m_per_s = section.number_or(
        "velocity-std-m-per-s",
        Allowed::POSITIVE,
        plan.velocity_std_m_per_s,
    );
    plan.particles = read_particles(&mut section);
    section.finish();
    plan
}

/// Reads the keys of particles; `None` for the Kalman filter.
fn read_particles(section: &mut Section<'_>) -> Option<ParticleKeys> {
    let kind = section
        .choice("kind", &KINDS)
        .map_or(Kind::Kalman, toml::Spanned::into_inner);
    if kind == Kind::Kalman {
        for key in OF_PARTICLES.into_iter().filter(|key| section.contains(key)) {
            let allowed = "must not be given without kind = \"particle\"";
            section.diagnostics().report(
                section.span_of(key),
                section.key(key),
                "has no effect",
                allowed,
            );
        }
        section.leave_unread(&OF_PARTICLES);
        return None;
    }
    let mut keys = ParticleKeys::default();
    if let Some(particles) = section.whole("particles", 2, MOST_PARTICLES) {
        keys.particles = particles.into_inner();
    }
    if let Some(density) = section.choice("density", &DENSITIES) {
        keys.density = density.into_inner();
    }
    keys.drift_per_root_s =
        section.number_or("drift", Allowed::NOT_NEGATIVE, keys.drift_per_root_s);
    keys.warm_up_s = section.number_or("warm-up-s", Allowed::NOT_NEGATIVE, keys.warm_up_s);
    Some(keys)
}

/// Reports settings that particles do not support.
///
/// The particle filter uses every sample and estimates all parameters in one filter.
pub(super) fn check_particles(
    file: &Section<'_>,
    plan: &FilterPlan,
    distributed: Option<&toml::Spanned<bool>>,
) {
    if plan.particles.is_none() {
        return;
    }
    for (table, why) in [
        (
            "outliers",
            "must not be given with filter.kind = \"particle\": particles use every sample",
        ),
        (
            "classes",
            "must not be given with filter.kind = \"particle\": particles identify each parameter \
             separately",
        ),
    ] {
        if file.contains(table) {
            file.diagnostics()
                .report(file.span_of(table), table, "is given", why);
        }
    }
    if let Some(distributed) = distributed.filter(|is| *is.get_ref()) {
        let allowed = "must not be distributed with filter.kind = \"particle\": nodes exchange \
                       Gaussian densities";
        file.diagnostics().report(
            distributed.span(),
            "structure.identification",
            "is \"distributed\"",
            allowed,
        );
    }
}

/// Reads a half-life (s) and checks its minimum number of time steps.
fn read_half_life(
    section: &mut Section<'_>,
    key: &'static str,
    rate_hz: Option<f64>,
) -> Option<f64> {
    let half_life = section.number(key, Allowed::POSITIVE)?;
    let least_s = LEAST_HALF_LIFE_STEPS / rate_hz?;
    if *half_life.get_ref() < least_s {
        let found = format!("is {}", half_life.get_ref());
        let allowed = format!("must be at least {LEAST_HALF_LIFE_STEPS} time steps, {least_s} s");
        section
            .diagnostics()
            .report(half_life.span(), section.key(key), found, allowed);
        return None;
    }
    Some(half_life.into_inner())
}

/// Allowed orders of the band limit.
///
/// Orders are even, because the poles come in pairs. A higher order adds delay and ringing, but
/// filters no better.
const ORDERS: [usize; 4] = [2, 4, 6, 8];

/// Reads `[band-limit]`, if present.
pub(super) fn read_band_limit(
    section: Option<Section<'_>>,
    rate_hz: Option<f64>,
) -> Option<BandLimit> {
    let mut section = section?;
    let frequency = section.required_number("frequency-hz", Allowed::POSITIVE);
    let order = read_order(&mut section);
    if let (Some(frequency), Some(rate_hz)) = (&frequency, rate_hz)
        && *frequency.get_ref() >= rate_hz / 2.0
    {
        let found = format!("is {}", frequency.get_ref());
        let allowed = format!("must be below half the sampling rate, {}", rate_hz / 2.0);
        section.diagnostics().report(
            frequency.span(),
            section.key("frequency-hz"),
            found,
            allowed,
        );
    }
    section.finish();
    Some(BandLimit {
        frequency_hz: frequency?.into_inner(),
        order,
    })
}

fn read_order(section: &mut Section<'_>) -> usize {
    let [lowest, .., highest] = ORDERS;
    let Some(order) = section.whole("order", lowest, highest) else {
        return BandLimit::ORDER;
    };
    if !ORDERS.contains(order.get_ref()) {
        let found = format!("is {}", order.get_ref());
        section.diagnostics().report(
            order.span(),
            section.key("order"),
            found,
            "must be 2, 4, 6 or 8",
        );
    }
    order.into_inner()
}

/// Reads `[ingest]`; `rate_hz` is the sampling rate of the structure.
pub(super) fn read_ingest(
    section: Option<Section<'_>>,
    rate_hz: Option<f64>,
) -> Option<IngestSettings> {
    let half_step_s = 0.5 / rate_hz?;
    let mut settings = IngestSettings {
        lateness_s: IngestSettings::LATENESS_S,
        tolerance_s: half_step_s,
    };
    let Some(mut section) = section else {
        return Some(settings);
    };
    settings.lateness_s =
        section.number_or("lateness-s", Allowed::NOT_NEGATIVE, settings.lateness_s);
    if let Some(tolerance) = section.number("tolerance-s", Allowed::POSITIVE) {
        settings.tolerance_s = *tolerance.get_ref();
        if settings.tolerance_s > half_step_s {
            let found = format!("is {}", tolerance.get_ref());
            let allowed = format!("must be at most half a time step, {half_step_s}");
            section.diagnostics().report(
                tolerance.span(),
                section.key("tolerance-s"),
                found,
                allowed,
            );
        }
    }
    section.finish();
    Some(settings)
}
