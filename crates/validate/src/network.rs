//! Identification of a structure by its sensor nodes and a station without a bus, or by one filter
//! with all samples.

use crate::error::ValidateError;
use crate::run::Run;
use crate::scene::Course;
use crate::statistics::Accuracy;
use spandrel_filter::fusion::{CompressedMotion, NodeReport, Taken};
use spandrel_filter::{ExtendedKalmanFilter, FilterSettings, Frame};
use spandrel_structure::{Structure, StructureModel};

/// Results of a distributed identification.
pub(crate) struct Fused {
    /// Fused estimates of each parameter at each fusion.
    pub(crate) courses: Vec<Course>,
    /// Each node's own estimates at each fusion, before the reply.
    pub(crate) local: Vec<Vec<Course>>,
    /// Reports by fusion and node.
    pub(crate) reports: Vec<Vec<NodeReport>>,
    /// Modal motion at each fusion, if the nodes send it.
    pub(crate) motion: Vec<Option<CompressedMotion>>,
    /// Number of restarts of each node.
    pub(crate) restarts: Vec<u64>,
}

/// A structure at the rate of its nodes, and their samples.
pub(crate) struct Network<'n> {
    pub(crate) structure: &'n Structure,
    pub(crate) frames: usize,
    /// Standard deviation of the noise of each channel.
    pub(crate) noise_std: &'n [f64],
    /// Sample of a frame and channel. Channels are numbered through all nodes.
    pub(crate) data: &'n dyn Fn(usize, usize) -> f64,
}

impl Network<'_> {
    fn time_s(&self, frame: usize) -> f64 {
        frame as f64 * self.structure.step_s()
    }

    /// Returns the number of frames in a fusion period.
    fn period(&self) -> usize {
        let rate_hz = self.structure.fusion().map_or(1.0, |plan| plan.rate_hz());
        (1.0 / (self.structure.step_s() * rate_hz)).round() as usize
    }

    /// Sets the true sensor noise for the filter of the node whose first channel is `first`.
    fn set_noise(&self, first: usize, settings: &mut FilterSettings) {
        settings.noise.sensors.fill(0.0);
        // A filter that receives the samples of other nodes has the channels of all nodes.
        let first = if settings.noise.sensors.nrows() == self.noise_std.len() {
            0
        } else {
            first
        };
        for channel in 0..settings.noise.sensors.nrows() {
            settings.noise.sensors[(channel, channel)] = self.noise_std[first + channel].powi(2);
        }
        settings.variance_bound.fill(f64::INFINITY);
    }

    /// Runs the nodes and the station, while the progress of the case rises between the two given
    /// shares.
    ///
    /// After each frame, `look` receives the filter of each node and the index of its first
    /// channel.
    pub(crate) fn fuse(
        &self,
        shares: (f64, f64),
        run: &Run<'_>,
        mut look: impl FnMut(usize, usize, &ExtendedKalmanFilter<StructureModel>),
    ) -> Result<Fused, ValidateError> {
        let structure = self.structure;
        let missing = || ValidateError::Example { what: "fusion" };
        let mut station = structure
            .station()
            .ok_or_else(missing)?
            .map_err(ValidateError::setting)?;
        let mut nodes = Vec::new();
        let mut first = 0;
        for (position, node) in structure.nodes().iter().enumerate() {
            let of_node = structure
                .local_filter_with(position, |own| self.set_noise(first, own))
                .ok_or_else(missing)?;
            nodes.push((
                of_node.map_err(ValidateError::setting)?,
                first,
                node.channels().len(),
            ));
            first += node.channels().len();
        }
        let parameters = structure.parameters().len();
        let mut fused = Fused {
            courses: vec![Course::default(); parameters],
            local: vec![vec![Course::default(); parameters]; nodes.len()],
            reports: Vec::new(),
            motion: Vec::new(),
            restarts: Vec::new(),
        };
        let excitation = vec![0.0; structure.excitations().len()];
        let mut observations = Vec::new();
        for frame in 0..self.frames {
            for (filter, first, channels) in &mut nodes {
                observations.clear();
                observations.extend(
                    (*first..*first + *channels).map(|channel| (self.data)(frame, channel)),
                );
                filter
                    .step(Frame {
                        observations: &observations,
                        excitation: &excitation,
                    })
                    .map_err(ValidateError::at(self.time_s(frame)))?;
                look(frame, *first, filter.filter());
            }
            if (frame + 1) % self.period() != 0 {
                continue;
            }
            let index = ((frame + 1) / self.period()) as f64;
            let (time_s, truth) = (self.time_s(frame), structure.true_parameters(frame as u64));
            for (position, (filter, ..)) in nodes.iter_mut().enumerate() {
                let report = filter.report();
                for (j, course) in fused.local[position].iter_mut().enumerate() {
                    let density = &report.parameters;
                    course.take(
                        time_s,
                        density.mean[j],
                        density.covariance[(j, j)],
                        truth[j],
                    );
                }
                // A report that cannot be used in this fusion appears as not received.
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
                course.take(
                    time_s,
                    result.parameters.mean[j],
                    result.parameters.covariance[(j, j)],
                    truth[j],
                );
            }
            fused.reports.push(result.nodes);
            fused.motion.push(result.motion);
            if !run.advance(shares.0 + (shares.1 - shares.0) * frame as f64 / self.frames as f64) {
                return Err(ValidateError::Stopped);
            }
        }
        fused.restarts = nodes.iter().map(|(filter, ..)| filter.restarts()).collect();
        Ok(fused)
    }

    /// Runs one filter with the unscreened samples of all nodes. Returns its estimates at the
    /// fusion times, by parameter.
    pub(crate) fn in_one_filter(
        &self,
        shares: (f64, f64),
        run: &Run<'_>,
    ) -> Result<Vec<Course>, ValidateError> {
        let structure = self.structure;
        let mut settings = structure
            .filter_settings()
            .map_err(ValidateError::setting)?;
        settings.misfit = None; // the published method
        self.set_noise(0, &mut settings);
        settings.outliers = None;
        let mut filter = ExtendedKalmanFilter::new(structure.model(), settings)
            .map_err(ValidateError::setting)?;
        let mut courses = vec![Course::default(); structure.parameters().len()];
        let excitation = vec![0.0; structure.excitations().len()];
        let mut observations = vec![0.0; self.noise_std.len()];
        for frame in 0..self.frames {
            observations
                .iter_mut()
                .enumerate()
                .for_each(|(channel, value)| *value = (self.data)(frame, channel));
            filter
                .step(Frame {
                    observations: &observations,
                    excitation: &excitation,
                })
                .map_err(ValidateError::at(self.time_s(frame)))?;
            if (frame + 1) % self.period() != 0 {
                continue;
            }
            let (density, truth) = (filter.parameters(), structure.true_parameters(frame as u64));
            for (j, course) in courses.iter_mut().enumerate() {
                course.take(
                    self.time_s(frame),
                    density.mean[j],
                    density.covariance[(j, j)],
                    truth[j],
                );
            }
            if !run.advance(shares.0 + (shares.1 - shares.0) * frame as f64 / self.frames as f64) {
                return Err(ValidateError::Stopped);
            }
        }
        Ok(courses)
    }
}

/// Returns the accuracy of one parameter without the start and the time after each damage.
pub(crate) fn settled(course: &Course, from_s: f64, damages: &[f64], after_s: f64) -> Accuracy {
    let mut accuracy = Accuracy::default();
    let counts = |time_s: f64| {
        time_s > from_s
            && !damages
                .iter()
                .any(|at| (*at..at + after_s).contains(&time_s))
    };
    for [_, mean, std, truth] in course.points.iter().filter(|point| counts(point[0])) {
        accuracy.take(*mean, *std, *truth);
    }
    accuracy
}
