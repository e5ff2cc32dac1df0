//! A scene identified by its sensor nodes and a station, without a bus between them.

use crate::error::ValidateError;
use crate::run::Run;
use crate::scene::{Course, Scene};
use crate::statistics::Accuracy;
use spandrel_filter::fusion::{CompressedMotion, NodeReport, Taken};
use spandrel_filter::{FilterSettings, Frame};

/// What is followed of a distributed identification.
pub(crate) struct Fused {
    /// by parameter, at each fusion
    pub(crate) courses: Vec<Course>,
    /// by node: its own estimates at each fusion, before the answer
    pub(crate) local: Vec<Vec<Course>>,
    /// by fusion and node
    pub(crate) reports: Vec<Vec<NodeReport>>,
    /// by fusion: the motion in modes, where it is sent so
    pub(crate) motion: Vec<Option<CompressedMotion>>,
    /// times nodes started anew
    pub(crate) restarts: u64,
}

/// Runs nodes and station over `data` (frames × channels) from this share of the case to that; `settings` changes those of the
/// filter of the node at its first channel.
pub(crate) fn fuse(
    scene: &Scene,
    settings: impl Fn(usize, &mut FilterSettings),
    data: impl Fn(usize, usize) -> f64,
    shares: (f64, f64),
    run: &Run<'_>,
) -> Result<Fused, ValidateError> {
    let structure = &scene.structure;
    let missing = || ValidateError::Example { what: "fusion" };
    let plan = structure.fusion().ok_or_else(missing)?;
    let mut station = structure.station().ok_or_else(missing)?.map_err(ValidateError::setting)?;
    let mut nodes = Vec::new();
    let mut first = 0;
    for (position, node) in structure.nodes().iter().enumerate() {
        let of_node = structure.local_filter_with(position, |own| settings(first, own)).ok_or_else(missing)?;
        nodes.push((of_node.map_err(ValidateError::setting)?, first, node.channels().len()));
        first += node.channels().len();
    }
    let parameters = structure.parameters().len();
    let mut fused = Fused {
        courses: vec![Course::default(); parameters],
        local: vec![vec![Course::default(); parameters]; nodes.len()],
        reports: Vec::new(),
        motion: Vec::new(),
        restarts: 0,
    };
    let period = (1.0 / (scene.step_s * plan.rate_hz())).round() as usize;
    let excitation = vec![0.0; structure.excitations().len()];
    let mut observations = Vec::new();
    for frame in 0..scene.frames {
        for (filter, first, channels) in &mut nodes {
            observations.clear();
            observations.extend((*first..*first + *channels).map(|channel| data(frame, channel)));
            filter
                .step(Frame { observations: &observations, excitation: &excitation })
                .map_err(ValidateError::at(scene.time_s(frame)))?;
        }
        if (frame + 1) % period != 0 {
            continue;
        }
        let index = ((frame + 1) / period) as f64;
        let (time_s, truth) = (scene.time_s(frame), structure.true_parameters(frame as u64));
        for (position, (filter, ..)) in nodes.iter_mut().enumerate() {
            let report = filter.report();
            for (j, course) in fused.local[position].iter_mut().enumerate() {
                let density = &report.parameters;
                course.take(time_s, density.mean[j], density.covariance[(j, j)], truth[j]);
            }
            // a node that is of no use in this fusion is reported as not heard
            let _ = station.receive(position, report, index);
        }
        let result = station.fuse(index);
        for ((filter, ..), feedback) in nodes.iter_mut().zip(&result.feedback) {
            if let Some(feedback) = feedback {
                let taken = filter.take(feedback);
                debug_assert_ne!(taken, Taken::Stale);
            }
        }
        for (j, course) in fused.courses.iter_mut().enumerate() {
            course.take(time_s, result.parameters.mean[j], result.parameters.covariance[(j, j)], truth[j]);
        }
        fused.reports.push(result.nodes);
        fused.motion.push(result.motion);
        if !run.advance(shares.0 + (shares.1 - shares.0) * frame as f64 / scene.frames as f64) {
            return Err(ValidateError::Stopped);
        }
    }
    fused.restarts = nodes.iter().map(|(filter, ..)| filter.restarts()).sum();
    Ok(fused)
}

/// Accuracy of one course outside of the start and of the time after each damage.
pub(crate) fn settled(course: &Course, from_s: f64, damages: &[f64], after_s: f64) -> Accuracy {
    let mut accuracy = Accuracy::default();
    let counts = |time_s: f64| time_s > from_s && !damages.iter().any(|at| (*at..at + after_s).contains(&time_s));
    for [_, mean, std, truth] in course.points.iter().filter(|point| counts(point[0])) {
        accuracy.take(*mean, *std, *truth);
    }
    accuracy
}
