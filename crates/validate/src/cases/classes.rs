//! Parts shared by the three examples of chapter 5: classes that compete over one record.

use crate::error::ValidateError;
use crate::outcome::{Plot, Series, SeriesKind};
use crate::run::Run;
use crate::scene::{Course, Scene};
use crate::statistics::Accuracy;
use spandrel_filter::{ClassBank, ClassEvent, ClassId, ClassSettings, FilterSettings};
use spandrel_structure::StructureClasses;

/// Time between two points of a curve (s).
const CURVE_EVERY_S: f64 = 0.05;

/// Results of the model classes over one record.
pub(super) struct Comparison {
    step_s: f64,
    /// Most plausible class at each frame.
    leaders: Vec<ClassId>,
    /// Events with their times (s).
    pub(super) events: Vec<(f64, ClassEvent)>,
    /// Estimate of each parameter of the file, combined over the classes.
    pub(super) courses: Vec<Course>,
    /// Plausibility of each class of the first level, sampled every [`CURVE_EVERY_S`].
    plausibilities: Vec<(String, Vec<(f32, f32)>)>,
    /// Accuracy of each watched state, from 5 s on.
    pub(super) responses: Vec<Accuracy>,
}

/// Returns the settings of the source: this prior deviation for every parameter, no start-up aid,
/// no bound on the variances, and a structure at rest.
pub(super) fn published_settings(
    scene: &Scene,
    parameter_std: f64,
) -> Result<FilterSettings, ValidateError> {
    let mut settings = scene.settings()?;
    settings.annealing = None;
    settings.variance_bound.fill(f64::INFINITY);
    let motion = settings.prior_std.len() - scene.structure.parameters().len();
    settings.prior_std.rows_mut(0, motion).fill(1e-5); // variance 10⁻¹⁰
    settings
        .prior_std
        .rows_mut(motion, scene.structure.parameters().len())
        .fill(parameter_std);
    Ok(settings)
}

/// Runs the classes over a record. `look` receives the bank after each frame.
pub(super) fn compare(
    scene: &Scene,
    settings: FilterSettings,
    classes: ClassSettings,
    shares: (f64, f64),
    run: &Run<'_>,
    mut look: impl FnMut(usize, &ClassBank<StructureClasses>),
) -> Result<Comparison, ValidateError> {
    let parameters = scene.structure.parameters().len();
    let mut seen = Comparison {
        step_s: scene.step_s,
        leaders: Vec::with_capacity(scene.frames),
        events: Vec::new(),
        courses: vec![Course::default(); parameters],
        plausibilities: Vec::new(),
        responses: vec![Accuracy::default(); scene.watched().len()],
    };
    let every = (CURVE_EVERY_S / scene.step_s).round().max(1.0) as usize;
    scene.compare(settings, classes, shares, run, |frame, bank| {
        let time_s = scene.time_s(frame);
        if let Some(leader) = bank.classes().nth(bank.leader()) {
            seen.leaders.push(leader);
        }
        seen.events
            .extend(bank.events().iter().map(|event| (time_s, event.clone())));
        if frame % every == 0 {
            let truth = scene.structure.true_parameters(frame as u64);
            for (j, course) in seen.courses.iter_mut().enumerate() {
                course.take(
                    time_s,
                    bank.parameter_mean()[j],
                    bank.parameter_covariance()[(j, j)],
                    truth[j],
                );
            }
            // A class that does not compete at this level has plausibility 0.
            for (_, points) in &mut seen.plausibilities {
                points.push((time_s as f32, 0.0));
            }
            for (class, plausibility) in bank.classes().zip(bank.plausibilities().iter()) {
                let name = scene.structure.class_name(class);
                let point = (time_s as f32, plausibility as f32);
                match seen
                    .plausibilities
                    .iter_mut()
                    .find(|(known, _)| known == name)
                {
                    Some((_, points)) => {
                        points.pop();
                        points.push(point);
                    }
                    None => seen.plausibilities.push((name.to_owned(), vec![point])),
                }
            }
        }
        if time_s >= 5.0 {
            let filter = bank.filter(bank.leader());
            for ((accuracy, state), truth) in seen
                .responses
                .iter_mut()
                .zip(scene.watched())
                .zip(scene.states(frame))
            {
                accuracy.take(
                    bank.motion()[*state],
                    filter.covariance()[(*state, *state)].max(0.0).sqrt(),
                    *truth,
                );
            }
        }
        look(frame, bank);
    })?;
    Ok(seen)
}

impl Comparison {
    /// Returns the share of the frames in a window (s) at which a class selected by `of` leads.
    pub(super) fn share(&self, from_s: f64, to_s: f64, of: impl Fn(ClassId) -> bool) -> f64 {
        let frame = |time_s: f64| ((time_s / self.step_s).round() as usize).min(self.leaders.len());
        let window = &self.leaders[frame(from_s)..frame(to_s)];
        window.iter().filter(|leader| of(**leader)).count() as f64 / window.len() as f64
    }

    /// Returns the time (s) from `from_s` to the first frame at which a class selected by `of`
    /// leads.
    pub(super) fn first_lead(&self, from_s: f64, of: impl Fn(ClassId) -> bool) -> f64 {
        let begin = (from_s / self.step_s).round() as usize;
        let found = self
            .leaders
            .iter()
            .skip(begin)
            .position(|leader| of(*leader));
        found.map_or(f64::NAN, |frames| frames as f64 * self.step_s)
    }

    /// Returns the time (s) from `from_s` to the first event selected by `of`.
    pub(super) fn first_event(&self, from_s: f64, of: impl Fn(&ClassEvent) -> bool) -> f64 {
        let found = self
            .events
            .iter()
            .find(|(time_s, event)| *time_s >= from_s && of(event));
        found.map_or(f64::NAN, |(time_s, _)| time_s - from_s)
    }

    /// Returns the times (s) of the calibrations in a window, each with its class.
    pub(super) fn calibrations(&self, from_s: f64, to_s: f64) -> Vec<(f64, ClassId)> {
        let calibration = |(time_s, event): &(f64, ClassEvent)| match event {
            ClassEvent::Calibrated { by, .. } => Some((*time_s, *by)),
            _ => None,
        };
        self.events
            .iter()
            .filter_map(calibration)
            .filter(|(time_s, _)| (from_s..to_s).contains(time_s))
            .collect()
    }

    /// Plots the plausibilities over time of all classes that ever led.
    pub(super) fn plausibility_plot(&self, title: &str) -> Plot {
        let curve = |points: &Vec<(f32, f32)>| {
            let every = (points.len() / 1200).max(1);
            points.iter().step_by(every).copied().collect()
        };
        let led = self
            .plausibilities
            .iter()
            .filter(|(_, points)| points.iter().any(|point| point.1 > 0.5));
        let series = led
            .map(|(name, points)| Series::new(name.clone(), SeriesKind::Estimate, curve(points)))
            .collect();
        Plot::over_time(title, "plausibility", series).within(0.0, 1.0)
    }

    /// Plots the estimate of a parameter with its interval.
    pub(super) fn parameter_plot(&self, parameter: usize, name: &str, range: (f32, f32)) -> Plot {
        self.courses[parameter].plot(name, "ratio to nominal", range)
    }
}

/// Returns the Rayleigh coefficients `α` and `β` that give the modes of these two angular
/// frequencies (rad/s) the same damping ratio.
pub(super) fn rayleigh(omega: [f64; 2], ratio: f64) -> [f64; 2] {
    let sum = omega[0] + omega[1];
    [2.0 * ratio * omega[0] * omega[1] / sum, 2.0 * ratio / sum]
}
