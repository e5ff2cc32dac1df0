//! The state machine: epochs in, one judgement per quantity and day out.

use crate::condition_watch::{ConditionWatch, Doubt};
use crate::course::Frame;
use crate::day::DAY_S;
use crate::epoch::Epoch;
use crate::error::JudgeError;
use crate::judgement::{Absence, Judgement};
use crate::quantity_watch::QuantityWatch;
use crate::report::QuantityReport;
use crate::settings::{Quantity, Settings};
use crate::thermometers::QuantityCourse;
use serde::{Deserialize, Serialize};

/// Times outside these years are mistakes (s since 1970-01-01 UTC).
const YEARS_S: (f64, f64) = (-2_208_988_800.0, 7_258_118_400.0);

/// The start of a new reference for one or all quantities.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NewReference {
    /// Start of the new reference (s since 1970-01-01 UTC).
    pub time_s: f64,
    /// Index of the quantity in the settings, or `None` for all quantities.
    pub quantity: Option<usize>,
}

/// Judges the quantities of one structure.
///
/// [`Judge::handle`] takes epochs in order of time and adds one judgement per quantity and day.
/// Each quantity first learns a reference in its commissioning. Until then, its judgements state
/// that the reference is being learnt. [`Judge::start_anew`] starts a new reference.
///
/// The judge has no clock: a day ends with the first epoch of a later day, or with
/// [`Judge::finish`]. The judge can be serialised at any point. The restored state gives the same
/// judgements, bit for bit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Judge {
    settings: Settings,
    last_s: Option<f64>,
    day: Option<i64>,
    watches: Vec<ConditionWatch>,
    quantity_watches: Vec<QuantityWatch>,
    absence: Option<Absence>,
    courses: Vec<QuantityCourse>,
    /// New references that start after the last epoch, in the order of time.
    awaited: Vec<NewReference>,
}

impl Judge {
    /// Creates a judge without any reference.
    ///
    /// # Errors
    /// Returns an error if a setting is outside its range.
    pub fn new(settings: Settings) -> Result<Self, JudgeError> {
        settings.check()?;
        Ok(Self {
            last_s: None,
            day: None,
            watches: vec![ConditionWatch::default(); settings.conditions.len()],
            quantity_watches: vec![QuantityWatch::default(); settings.quantities.len()],
            absence: None,
            courses: courses(&settings),
            awaited: Vec::new(),
            settings,
        })
    }

    /// Returns the settings.
    #[must_use]
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Schedules a new reference. It starts with the next epoch at or after
    /// [`NewReference::time_s`].
    ///
    /// The commissioning, the change, and the earlier epochs of the same day are then discarded.
    /// Epochs that were handled before this call count as earlier.
    pub fn start_anew(&mut self, new: NewReference) {
        let place = self
            .awaited
            .partition_point(|awaited| awaited.time_s <= new.time_s);
        self.awaited.insert(place, new);
    }

    /// Returns `true` if the next epochs start a new reference of the quantity with this index.
    #[must_use]
    pub fn awaits_reference(&self, quantity: usize) -> bool {
        let concerns = |new: &NewReference| new.quantity.is_none_or(|index| index == quantity);
        self.awaited.iter().any(concerns)
    }

    /// Takes an epoch. Adds the judgements of a day to `judgements` if the epoch begins a later
    /// one.
    ///
    /// # Errors
    /// Returns an error if the epoch is not later than the previous one, or does not match the
    /// settings. The epoch is then ignored.
    pub fn handle(
        &mut self,
        epoch: &Epoch,
        judgements: &mut Vec<Judgement>,
    ) -> Result<(), JudgeError> {
        self.check(epoch)?;
        let day = (epoch.time_s / DAY_S).floor() as i64;
        if let Some(open) = self.day.filter(|open| day > *open) {
            self.end_day(open, judgements);
        }
        while let Some(new) = self.awaited.first().copied()
            && new.time_s <= epoch.time_s
        {
            self.awaited.remove(0);
            self.forget(new.quantity);
        }
        self.day = Some(day);
        self.last_s = Some(epoch.time_s);
        let logarithms = self.logarithms(epoch);
        let Some(conditions) = self.conditions(epoch) else {
            return Ok(());
        };
        let declared = logarithms.iter().zip(&self.settings.quantities);
        let stiffnesses: Vec<Option<f64>> = declared
            .map(|(y, quantity)| Some((*y)? / quantity.kind.per_stiffness()))
            .collect();
        for (course, y) in self.courses.iter_mut().zip(&logarithms) {
            if let Some(y) = y {
                course.add(*y, &conditions, &stiffnesses);
            }
        }
        Ok(())
    }

    /// Ends the open day, as a later epoch would.
    pub fn finish(&mut self, judgements: &mut Vec<Judgement>) {
        if let Some(open) = self.day.take() {
            self.end_day(open, judgements);
        }
    }

    /// Returns a report of every quantity.
    #[must_use]
    pub fn report(&self) -> Vec<QuantityReport> {
        let quantities = self.settings.quantities.iter().zip(&self.courses);
        quantities
            .map(|(quantity, course)| QuantityReport::new(&quantity.name, course))
            .collect()
    }

    fn forget(&mut self, quantity: Option<usize>) {
        match quantity {
            None => {
                self.courses = courses(&self.settings);
                self.quantity_watches.fill(QuantityWatch::default());
            }
            Some(index) => {
                if let Some(watch) = self.quantity_watches.get_mut(index) {
                    *watch = QuantityWatch::default();
                }
                for course in &mut self.courses {
                    course.begin_again(index);
                }
                let declared = self.settings.quantities.get(index);
                if let (Some(course), Some(quantity)) = (self.courses.get_mut(index), declared) {
                    *course = QuantityCourse::new(quantity, &self.settings);
                }
            }
        }
        // A thermometer that was moved has jumped for all quantities.
        if quantity.is_none() || self.courses.len() == 1 {
            self.watches.fill(ConditionWatch::default());
        }
    }

    fn check(&self, epoch: &Epoch) -> Result<(), JudgeError> {
        let time_s = epoch.time_s;
        let (first, last) = YEARS_S;
        if !(first..=last).contains(&time_s) {
            return Err(JudgeError::NoTime { time_s });
        }
        if let Some(previous_s) = self.last_s.filter(|previous_s| time_s <= *previous_s) {
            return Err(JudgeError::OutOfOrder { time_s, previous_s });
        }
        let shapes = [
            (
                "quantities",
                epoch.quantities.len(),
                self.settings.quantities.len(),
            ),
            (
                "conditions",
                epoch.conditions.len(),
                self.settings.conditions.len(),
            ),
        ];
        match shapes
            .into_iter()
            .find(|(_, found, expected)| found != expected)
        {
            Some((what, found, expected)) => Err(JudgeError::Shape {
                what,
                found,
                expected,
            }),
            None => Ok(()),
        }
    }

    /// Returns ln(value) of each quantity, or `None` if it is missing, is frozen or has jumped.
    fn logarithms(&mut self, epoch: &Epoch) -> Vec<Option<f64>> {
        let declared = self.settings.quantities.iter();
        let declared = declared.zip(&mut self.quantity_watches);
        let logarithm = |((quantity, watch), value): ((&Quantity, &mut QuantityWatch), _)| {
            let value: Option<f64> = value;
            let y = value
                .filter(|value| value.is_finite() && *value > 0.0)?
                .ln();
            let doubt = watch.doubt(epoch.time_s, y / quantity.kind.per_stiffness());
            doubt.is_none().then_some(y)
        };
        let values = epoch.quantities.iter().copied();
        declared.zip(values).map(logarithm).collect()
    }

    /// Returns the conditions in the scale of the model, or `None` if one is missing, is frozen or
    /// has jumped.
    fn conditions(&mut self, epoch: &Epoch) -> Option<Vec<f64>> {
        let mut values = Vec::with_capacity(epoch.conditions.len());
        let mut absence = None;
        let declared = self.settings.conditions.iter().zip(&mut self.watches);
        for ((condition, watch), value) in declared.zip(&epoch.conditions) {
            let value = value.and_then(|value| condition.kind.convert(value).ok());
            let Some(value) = value else {
                absence = Some(Absence::Condition(condition.name.clone()));
                continue;
            };
            match watch.doubt(epoch.time_s, value, condition.kind.is_temperature()) {
                Some(Doubt::Frozen) => absence = Some(Absence::Frozen(condition.name.clone())),
                Some(Doubt::Jumped) => absence = Some(Absence::Jumped(condition.name.clone())),
                None => values.push(value),
            }
        }
        match absence {
            Some(absence) => {
                self.absence = Some(absence);
                None
            }
            None => Some(values),
        }
    }

    fn end_day(&mut self, day: i64, judgements: &mut Vec<Judgement>) {
        let of_conditions = self.absence.take();
        let absences = self.absences_of_quantities();
        // Thermometers come first. A change that is raised on this day counts at once.
        let mut order: Vec<usize> = (0..self.courses.len()).collect();
        order.sort_by_key(|index| !self.settings.quantities[*index].thermometers.is_empty());
        let mut of_day = Vec::with_capacity(order.len());
        for index in order {
            let judgement = self.courses[index].end_day(Frame {
                settings: &self.settings,
                quantity: &self.settings.quantities[index],
                index,
                thermometer: None,
                day,
                absence: absences[index].as_ref().or(of_conditions.as_ref()),
            });
            if judgement.raised {
                self.stop(index);
            }
            of_day.push((index, judgement));
        }
        of_day.sort_by_key(|(index, _)| *index);
        judgements.extend(of_day.into_iter().map(|(_, judgement)| judgement));
    }

    /// Returns why quantities have no statement of the open day for their own values. A day that
    /// only repeats the day before is discarded.
    fn absences_of_quantities(&mut self) -> Vec<Option<Absence>> {
        let ended = self.quantity_watches.iter_mut();
        let ended: Vec<_> = ended.map(QuantityWatch::end_day).collect();
        for (index, _) in ended.iter().enumerate().filter(|(_, (_, all))| *all) {
            for (place, course) in self.courses.iter_mut().enumerate() {
                course.discard_day(index, place == index);
            }
        }
        let absence = |(doubt, _): (Option<Doubt>, bool)| {
            Some(match doubt? {
                Doubt::Frozen => Absence::FrozenQuantity,
                Doubt::Jumped => Absence::OtherUnit,
            })
        };
        ended.into_iter().map(absence).collect()
    }

    /// Takes note that a quantity has changed.
    fn stop(&mut self, quantity: usize) {
        for course in &mut self.courses {
            course.stop(quantity);
        }
    }
}

/// Returns the courses of all quantities, without a reference.
fn courses(settings: &Settings) -> Vec<QuantityCourse> {
    let quantities = settings.quantities.iter();
    quantities
        .map(|quantity| QuantityCourse::new(quantity, settings))
        .collect()
}
