//! Prediction of the state at the time of the new frame, equations (2.61) and (2.67).

use super::propagator::Propagator;
use super::state::StepExcitation;
use super::{ExtendedKalmanFilter, Frame};
use crate::discretise::InputHold;
use crate::model::{ObservationModel, ProcessModel};
use crate::product::Left;

impl<M: ProcessModel + ObservationModel> ExtendedKalmanFilter<M> {
    /// Writes the known excitation at both ends of the step and the variances of missing samples.
    ///
    /// It also adds the part of the excitation that the last step omitted to the filtered state.
    pub(super) fn take_excitation(&mut self, frame: Frame<'_>) {
        let Self { state, work, .. } = self;
        for j in 0..work.older.len() {
            let share = work.reliability[j];
            let (older, newer) = (
                share * state.last_excitation[j],
                share * frame.excitation[j],
            );
            work.older[j] = if older.is_nan() { 0.0 } else { older };
            work.newer[j] = if newer.is_nan() { 0.0 } else { newer };
            let course = state.excitation_course.as_ref();
            work.above_the_line[j] =
                course.map_or(0.0, |course| course.above_the_line(j, older, newer));
            if let Some(course) = course {
                course.make_up(j, older, newer, &mut state.mean);
            }
            work.missing[j] = if older.is_nan() {
                state.excitation_mean_square[j]
            } else {
                0.0
            };
        }
    }

    /// Writes mean, `λ A Σ Aᵀ` and `B` for the time of the new frame. The first frame uses the
    /// prior instead.
    pub(super) fn predict(&mut self) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        work.mean.copy_from(&state.mean);
        match state.step_excitation() {
            StepExcitation::AtPrior => {
                work.covariance.copy_from(&state.covariance);
                if work.propagator.time_invariant().is_none() {
                    work.input_matrix.fill(0.0);
                }
                return;
            }
            StepExcitation::WhiteNoise => {}
            StepExcitation::Inferred(posterior) => work.older += &posterior.mean,
        }
        work.older += &work.above_the_line;
        if let Propagator::TimeInvariant(constant) = &mut work.propagator {
            let held = &work.older;
            let ramp = (settings.input_hold == InputHold::First).then(|| {
                work.newer_less_older.copy_from(&work.newer);
                work.newer_less_older -= held;
                work.newer_less_older += &work.above_the_line;
                &work.newer_less_older
            });
            constant.predict_mean_mut(&mut work.mean, held, ramp);
        } else {
            model.linearise_process(state.mean.as_slice(), work.older.as_slice());
            self.discretise();
        }
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        work.propagator.propagate_covariance_to(
            model,
            settings.step_s,
            settings.fading.value(),
            &state.covariance,
            &mut work.covariance,
        );
        self.add_inferred_excitation();
    }

    /// Discretises the model at its linearisation point; writes the mean and `B`.
    fn discretise(&mut self) {
        let Self {
            model,
            settings,
            work,
            ..
        } = self;
        model.excitation_matrix(&mut work.input_matrix);
        let n = work.mean.len();
        model.derivative(&mut work.inputs.as_mut_slice()[..n]);
        work.inputs.as_mut_slice()[n..].copy_from_slice(work.input_matrix.as_slice());
        let step_s = settings.step_s;
        let ramp = (settings.input_hold == InputHold::First).then(|| {
            work.older.axpy(1.0, &work.newer, -1.0); // slope, per step
            work.older += &work.above_the_line;
            work.ramp
                .gemv(1.0 / step_s, &work.input_matrix, &work.older, 0.0);
            work.ramp.as_slice()
        });
        work.propagator
            .discretise(model, step_s, &mut work.inputs, ramp);
        for (mean, increment) in work.mean.iter_mut().zip(&work.inputs.as_slice()[..n]) {
            *mean += increment; // y ← y + Γ g (2.67)
        }
        work.input_matrix
            .as_mut_slice()
            .copy_from_slice(&work.inputs.as_slice()[n..]); // B = Γ B_y
    }

    /// Adds the excitation that the previous frame has measured to the predicted covariance.
    fn add_inferred_excitation(&mut self) {
        let Self {
            model,
            settings,
            state,
            work,
            ..
        } = self;
        let StepExcitation::Inferred(posterior) = state.step_excitation() else {
            return;
        };
        work.cross.copy_from(&posterior.cross);
        work.propagator
            .mul_mut(model, settings.step_s, &mut work.cross); // A C
        // A Σ Aᵀ + A C Bᵀ + B Cᵀ Aᵀ + B W Bᵀ: the last frame has already measured the excitation of
        // this step. Half of the last term is added to each of the two terms before it. This leaves
        // one product of rank 2N_f, which is cheap even with many forces.
        let inputs = work.cross.ncols();
        for b in 0..inputs {
            work.cross.column_mut(b).gemv(
                0.5,
                &work.input_matrix,
                &posterior.covariance.column(b),
                1.0,
            );
        }
        work.pair.columns_mut(0, inputs).copy_from(&work.cross);
        work.pair
            .columns_mut(inputs, inputs)
            .copy_from(&work.input_matrix);
        work.swapped_pair
            .rows_mut(0, inputs)
            .tr_copy_from(&work.input_matrix);
        work.swapped_pair
            .rows_mut(inputs, inputs)
            .tr_copy_from(&work.cross);
        work.by_pair.pack(&work.swapped_pair);
        work.pair *= settings.fading.value();
        let (left, variances) = (Left::new(&work.pair), work.update.variances.as_mut_slice());
        work.multiplier
            .add_symmetric_mut(left, &work.by_pair, &mut work.covariance, variances);
    }
}
