//! Forms epochs: means of the estimates, with the conditions at that time.
//!
//! An epoch is a stretch of measurement time that begins at a multiple of its length since 1970. It
//! is closed when an estimate of the second next epoch arrives, so that conditions have one epoch
//! of time to arrive. Its value of a quantity is the geometric mean of the estimates, because the
//! judgement concerns ln(value). An estimate counts only if the present data reveal damage of its
//! parameter, and if it is known whether its samples are measured.
//!
//! Values in an earthquake do not count, until the structure has settled.
//!
//! A time of the future would exclude all values until then. Values ahead of the clock of the
//! machine therefore do not count. That clock can be wrong as well. If it is set back, epochs that
//! are now ahead of it are dropped. Measured values that jump ahead by more than a day close no
//! epoch until a value of the second next epoch confirms the jump.
//!
//! An estimate or mode that does not count opens its epoch nevertheless. An epoch without any value
//! lets the judge state that the day has none.
//!
//! The natural frequency of a declared mode counts for the epoch in which its own epoch ends. It
//! counts also while the monitoring is blind, because it depends on no model. A mode that is
//! paired, or at whose frequency a machine runs, does not count.

use crate::ahead::{Ahead, AheadReports};
use spandrel_bus::{
    ConditionDisplay, ModeDisplay, ModeState, MonitoringDisplay, MonitoringState, Name,
    ParameterDisplay, REFERENCE_IS_LEARNT,
};
use spandrel_judge::{ConditionKind, Epoch};
use spandrel_structure::Condition;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// Silence of the alert service after which nothing is known about the monitoring. The service
/// reports each second.
const UNKNOWN_AFTER: Duration = Duration::from_secs(5);
/// Number of expected intervals for which the value of a condition holds.
const HOLDS_FOR_INTERVALS: f64 = 2.0;
/// Maximum number of epochs for which values of a condition are kept. Conditions arrive without
/// estimates while the monitoring is blind.
const CONDITIONS_KEPT: usize = 64;
/// Time from the beginning of an earthquake until the structure has settled (ns): the longest
/// recording of 10 minutes, after which an earthquake that continues begins again, and 5 minutes.
const SETTLED_AFTER_NS: i64 = 900_000_000_000;
/// Maximum number of earthquakes that concern epochs which are not closed yet.
const MOST_EARTHQUAKES: usize = 64;
/// Distance from the newest value above which a value is a jump ahead (ns). An unconfirmed jump by
/// less delays the judgement by at most a day.
const JUMP_NS: i64 = 86_400_000_000_000;
/// The same distance in epochs, if they are long. A single missing epoch is no jump.
const LEAST_JUMP: i64 = 2;
/// Difference between the scales K and °C.
const KELVIN_OF_0_CELSIUS: f64 = 273.15;
const NS_PER_S: f64 = 1e9;

/// What the epochs are formed of.
#[derive(Debug, Clone)]
pub(crate) struct Sources {
    /// Length of an epoch (ns).
    pub(crate) length_ns: i64,
    /// Source of each quantity, in the order of the settings. `None` if the quantity is neither a
    /// parameter nor a declared mode of the structure.
    pub(crate) quantities: Vec<Option<QuantitySource>>,
    /// Conditions, in the order of the settings.
    pub(crate) conditions: Vec<ConditionSource>,
    /// Whether natural frequencies update the parameters. No alert service then reports on the
    /// monitoring.
    pub(crate) is_updated: bool,
}

/// Where the live values of a quantity come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum QuantitySource {
    /// The estimates of a parameter.
    Parameter(Name),
    /// The frequencies of a declared mode.
    Mode(Name),
}

/// A condition of the judgement.
#[derive(Debug, Clone)]
pub(crate) struct ConditionSource {
    pub(crate) name: Name,
    pub(crate) kind: ConditionKind,
    /// The condition as the structure file describes it, if it does.
    pub(crate) declared: Option<Condition>,
}

/// A message or the passage of time.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum EpochInput {
    /// Time since a fixed moment. Later inputs are received at this time.
    Now(Duration),
    /// Time of the machine (ns since 1970-01-01 UTC).
    Clock(i64),
    Monitoring(MonitoringDisplay),
    /// Whether the samples are measured now. `None` if that is unknown.
    Measured(Option<bool>),
    Condition(ConditionDisplay),
    /// An earthquake has begun (ns since 1970-01-01 UTC).
    Earthquake(i64),
    Parameter(ParameterDisplay),
    Mode(Box<ModeDisplay>),
}

/// An epoch that is over.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ClosedEpoch {
    /// Middle (ns since 1970-01-01 UTC).
    pub(crate) middle_ns: i64,
    /// Values of the quantities and conditions.
    pub(crate) epoch: Epoch,
    /// Standard deviation of ln(value) of each quantity: of the estimates, and between them.
    pub(crate) deviations: Vec<Option<f64>>,
    /// Whether all samples were measured.
    pub(crate) is_measured: bool,
}

impl ClosedEpoch {
    /// Returns the time in the unit of the judgement (s), exactly as a reader of a series does.
    pub(crate) fn time_s(middle_ns: i64) -> f64 {
        middle_ns as f64 * 1e-9
    }
}

/// The epochs that are not over yet.
#[derive(Debug)]
pub(crate) struct Epochs {
    sources: Sources,
    /// Epochs by their numbers.
    open: BTreeMap<i64, Open>,
    /// Values of each condition, by the number of the epoch.
    conditions: Vec<ConditionValues>,
    /// Beginnings of the last earthquakes (ns).
    earthquakes: VecDeque<i64>,
    /// Number of the last closed epoch.
    closed: Option<i64>,
    /// Number of the newest epoch that follows no unconfirmed jump ahead.
    present: Option<i64>,
    /// Number of the first epoch after an unconfirmed jump ahead.
    jump: Option<i64>,
    ahead: AheadReports,
    monitoring: Option<(MonitoringDisplay, Duration)>,
    is_measured: Option<bool>,
    now: Duration,
    clock_ns: i64,
    newest_ns: Option<i64>,
    /// Time of the last message of each mode, which is repeated (ns).
    modes: BTreeMap<Name, i64>,
    /// Time of the last message of each parameter (ns).
    parameters: BTreeMap<Name, i64>,
    refused: BTreeMap<&'static str, u64>,
}

/// An epoch that is not over yet.
#[derive(Debug)]
struct Open {
    quantities: Vec<Sums>,
    is_measured: bool,
}

/// Sums over the estimates of one quantity.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    count: u32,
    /// Σ ln(value) and Σ ln(value)², relative to `first`.
    log: f64,
    square: f64,
    first: f64,
    /// Σ (std / mean)².
    variance: f64,
}

#[derive(Debug, Default)]
struct ConditionValues {
    by_epoch: BTreeMap<i64, ConditionMean>,
    newest_ns: Option<i64>,
}

#[derive(Debug, Clone, Copy)]
struct ConditionMean {
    count: u32,
    sum: f64,
    last: f64,
    last_ns: i64,
    /// Time for which the last value holds (ns).
    holds_ns: i64,
}

impl Epochs {
    /// Begins after the epoch with this middle (ns), which an earlier run has closed.
    pub(crate) fn new(sources: Sources, closed_ns: Option<i64>) -> Self {
        let conditions = sources.conditions.iter();
        let closed = closed_ns.map(|middle_ns| middle_ns.div_euclid(sources.length_ns));
        Self {
            open: BTreeMap::new(),
            conditions: conditions.map(|_| ConditionValues::default()).collect(),
            earthquakes: VecDeque::new(),
            closed,
            present: closed,
            jump: None,
            ahead: AheadReports::default(),
            monitoring: None,
            is_measured: None,
            now: Duration::ZERO,
            clock_ns: i64::MAX,
            newest_ns: closed_ns,
            modes: BTreeMap::new(),
            parameters: BTreeMap::new(),
            refused: BTreeMap::new(),
            sources,
        }
    }

    /// Returns the length of an epoch (ns).
    pub(crate) fn length_ns(&self) -> i64 {
        self.sources.length_ns
    }

    /// Returns the time of the newest estimate (ns since 1970-01-01 UTC).
    pub(crate) fn newest_ns(&self) -> Option<i64> {
        self.newest_ns
    }

    /// Returns the number of inputs that were not used, by reason.
    pub(crate) fn refused(&self) -> &BTreeMap<&'static str, u64> {
        &self.refused
    }

    /// Returns what is ahead of the clock of the machine and not reported yet.
    pub(crate) fn take_ahead(&mut self) -> Vec<Ahead> {
        self.ahead.drain()
    }

    /// Takes an input, and appends the epochs that it closes to `closed`.
    pub(crate) fn handle(&mut self, input: EpochInput, closed: &mut Vec<ClosedEpoch>) {
        match input {
            EpochInput::Now(now) => self.now = now,
            EpochInput::Clock(clock_ns) => self.set_clock(clock_ns),
            EpochInput::Monitoring(display) => self.monitoring = Some((display, self.now)),
            EpochInput::Measured(is_measured) => self.is_measured = is_measured,
            EpochInput::Condition(display) => {
                if let Err(reason) = self.take_condition(&display) {
                    *self.refused.entry(reason).or_default() += 1;
                }
            }
            EpochInput::Earthquake(begin_ns) => {
                self.earthquakes.push_back(begin_ns);
                if self.earthquakes.len() > MOST_EARTHQUAKES {
                    self.earthquakes.pop_front();
                }
            }
            EpochInput::Parameter(display) => {
                if let Err(reason) = self.take_parameter(&display, closed) {
                    *self.refused.entry(reason).or_default() += 1;
                }
            }
            EpochInput::Mode(display) => {
                if let Err(reason) = self.take_mode(&display, closed) {
                    *self.refused.entry(reason).or_default() += 1;
                }
            }
        }
    }

    fn take_parameter(
        &mut self,
        display: &ParameterDisplay,
        closed: &mut Vec<ClosedEpoch>,
    ) -> Result<(), &'static str> {
        let source = QuantitySource::Parameter(display.parameter.clone());
        let Some(index) = self.quantity(&source) else {
            return Ok(()); // not judged
        };
        if self.is_ahead(&display.parameter, display.time_ns) {
            return Err("ahead-of-clock-estimates");
        }
        let last = self
            .parameters
            .insert(display.parameter.clone(), display.time_ns);
        if self.sources.is_updated && last == Some(display.time_ns) {
            return Ok(()); // repeated for late subscribers
        }
        let number = self
            .reach(display.time_ns, closed)
            .ok_or("late-estimates")?;
        let is_measured = self.is_measured.ok_or("estimates-of-unknown-origin")?;
        if !self.sources.is_updated && !self.is_sighted(&display.parameter) {
            return Err("blind-estimates");
        }
        if display.mean.is_nan() || display.mean <= 0.0 {
            return Err("impossible-estimates");
        }
        self.add(number, index, is_measured, [display.mean, display.std]);
        Ok(())
    }

    fn take_mode(
        &mut self,
        display: &ModeDisplay,
        closed: &mut Vec<ClosedEpoch>,
    ) -> Result<(), &'static str> {
        let source = QuantitySource::Mode(display.mode.clone());
        let Some(index) = self.quantity(&source) else {
            return Ok(()); // not judged
        };
        if self.is_ahead(&display.mode, display.time_ns) {
            return Err("ahead-of-clock-modes");
        }
        let last = self.modes.insert(display.mode.clone(), display.time_ns);
        if last == Some(display.time_ns) {
            return Ok(()); // repeated for late subscribers
        }
        let number = self.reach(display.time_ns, closed).ok_or("late-modes")?;
        let Some(estimate) = &display.estimate else {
            return Ok(()); // missing or lost
        };
        let is_measured = self.is_measured.ok_or("modes-of-unknown-origin")?;
        if display.state == ModeState::Paired {
            return Err("paired-modes");
        }
        if display.machine {
            return Err("machine-modes");
        }
        let value = [estimate.frequency_hz, estimate.frequency_std_hz];
        self.add(number, index, is_measured, value);
        Ok(())
    }

    /// Opens the epoch of a value, and closes those that are over. Returns the number of the epoch,
    /// or `None` if it is closed already.
    fn reach(&mut self, time_ns: i64, closed: &mut Vec<ClosedEpoch>) -> Option<i64> {
        let length_ns = self.sources.length_ns;
        let number = time_ns.div_euclid(length_ns);
        if let Some(last) = self.closed.filter(|last| number <= *last) {
            if last.saturating_mul(length_ns) > self.latest_ns() {
                let end_ns = last.saturating_add(1).saturating_mul(length_ns);
                self.ahead.take(Ahead::Epoch { end_ns }, self.now);
            }
            return None;
        }
        if self.is_confirmed(number) {
            self.newest_ns = self.newest_ns.max(Some(time_ns));
            self.close_before(number.saturating_sub(1), closed);
        }
        self.open(number);
        Some(number)
    }

    /// Returns `true` if the epoch with this number follows no jump ahead, or confirms a jump. If
    /// it is before an unconfirmed jump, drops the epochs after the jump.
    ///
    /// Replayed and simulated samples may jump.
    fn is_confirmed(&mut self, number: i64) -> bool {
        let most = LEAST_JUMP.max(JUMP_NS / self.sources.length_ns);
        let is_jump = |present: i64| number > present.saturating_add(most);
        if self.is_measured != Some(false) && self.present.is_some_and(is_jump) {
            let first = self.jump.map_or(number, |first| first.min(number));
            self.jump = Some(first);
            if number < first.saturating_add(2) {
                return false;
            }
        } else if let Some(first) = self.jump {
            self.drop_from(first, "unconfirmed-epochs");
        }
        self.jump = None;
        self.present = self.present.max(Some(number));
        true
    }

    /// Drops the open epochs from a number on, and counts them.
    fn drop_from(&mut self, first: i64, reason: &'static str) {
        let before = self.open.len();
        self.open.retain(|number, _| *number < first);
        let dropped = before - self.open.len();
        if dropped > 0 {
            *self.refused.entry(reason).or_default() += dropped as u64;
        }
    }

    /// Takes the time of the machine. If its clock was set back, forgets what is now ahead of it.
    fn set_clock(&mut self, clock_ns: i64) {
        self.clock_ns = clock_ns;
        let latest_ns = self.latest_ns();
        let first = latest_ns
            .div_euclid(self.sources.length_ns)
            .saturating_add(1);
        self.drop_from(first, "ahead-of-clock-epochs");
        self.jump = self.jump.filter(|jump| *jump < first);
        if self.present >= Some(first) {
            let last = self.open.last_key_value();
            self.present = self.closed.max(last.map(|(number, _)| *number));
        }
        self.newest_ns = self.newest_ns.filter(|newest_ns| *newest_ns <= latest_ns);
        for values in &mut self.conditions {
            values.forget_after(latest_ns, first);
        }
    }

    fn quantity(&self, source: &QuantitySource) -> Option<usize> {
        let mut quantities = self.sources.quantities.iter();
        quantities.position(|known| known.as_ref() == Some(source))
    }

    /// Returns an epoch. Without values, it is neither replayed nor simulated.
    fn open(&mut self, number: i64) -> &mut Open {
        let quantities = self.sources.quantities.len();
        self.open.entry(number).or_insert_with(|| Open {
            quantities: vec![Sums::default(); quantities],
            is_measured: true,
        })
    }

    /// Adds a value with its standard deviation to an epoch.
    fn add(&mut self, number: i64, index: usize, is_measured: bool, [value, std]: [f64; 2]) {
        let open = self.open(number);
        open.is_measured &= is_measured;
        if let Some(sums) = open.quantities.get_mut(index) {
            sums.add(value, std);
        }
    }

    /// Returns `true` if the present data reveal damage of a parameter. While the alert service
    /// learns a reference, they do.
    fn is_sighted(&self, parameter: &Name) -> bool {
        let Some((display, at)) = &self.monitoring else {
            return false;
        };
        if self.now.saturating_sub(*at) > UNKNOWN_AFTER {
            return false;
        }
        let is_blind = display.state == MonitoringState::Blind && !display.only_learns();
        let mut parameters = display.parameters.iter();
        let of_it = parameters.find(|of| of.parameter == *parameter);
        let is_blind_here = of_it.is_some_and(|of| {
            of.state == MonitoringState::Blind && of.why.as_deref() != Some(REFERENCE_IS_LEARNT)
        });
        !is_blind && !is_blind_here
    }

    /// Returns the latest time of a value that is not ahead of the clock (ns).
    fn latest_ns(&self) -> i64 {
        self.clock_ns.saturating_add(ConditionDisplay::MAX_AHEAD_NS)
    }

    /// Returns `true` if a value is ahead of the clock, and reports this.
    fn is_ahead(&mut self, of: &Name, time_ns: i64) -> bool {
        let is_ahead = time_ns > self.latest_ns();
        if is_ahead {
            let of = of.clone();
            self.ahead.take(Ahead::Values { of, time_ns }, self.now);
        }
        is_ahead
    }

    fn take_condition(&mut self, display: &ConditionDisplay) -> Result<(), &'static str> {
        let latest_ns = self.latest_ns();
        let mut sources = self.sources.conditions.iter().zip(&mut self.conditions);
        let Some((source, values)) = sources.find(|(source, _)| source.name == display.name) else {
            return Ok(()); // explains nothing
        };
        let declared = source.declared.as_ref();
        let is_in_unit = declared.is_none_or(|declared| declared.unit() == display.unit);
        let value = source.value(display).filter(|_| is_in_unit);
        let value = value.ok_or("wrong-unit-conditions")?;
        let is_plausible = declared.is_none_or(|declared| declared.is_plausible(display.value));
        if !is_plausible || source.kind.convert(value).is_err() {
            return Err("out-of-range-conditions");
        }
        if display.time_ns > latest_ns {
            let (of, time_ns) = (display.name.clone(), display.time_ns);
            self.ahead.take(Ahead::Values { of, time_ns }, self.now);
            return Err("ahead-of-clock-conditions");
        }
        if values.newest_ns >= Some(display.time_ns) {
            return Err("repeated-conditions");
        }
        let length_ns = self.sources.length_ns;
        let number = display.time_ns.div_euclid(length_ns);
        values.newest_ns = Some(display.time_ns);
        let declared_s = declared.and_then(Condition::interval_s);
        let interval_s = display.interval_s.or(declared_s).unwrap_or(0.0);
        let holds_ns = (HOLDS_FOR_INTERVALS * interval_s * NS_PER_S) as i64;
        let mean = values.by_epoch.entry(number).or_insert(ConditionMean {
            count: 0,
            sum: 0.0,
            last: value,
            last_ns: display.time_ns,
            holds_ns: length_ns,
        });
        mean.count += 1;
        mean.sum += value;
        (mean.last, mean.last_ns) = (value, display.time_ns);
        mean.holds_ns = holds_ns.max(length_ns);
        if values.by_epoch.len() > CONDITIONS_KEPT {
            values.by_epoch.pop_first();
            return Err("conditions-not-kept"); // those of the first epoch
        }
        Ok(())
    }

    /// Closes all epochs before a number.
    fn close_before(&mut self, number: i64, closed: &mut Vec<ClosedEpoch>) {
        while let Some(first) = self.open.first_entry() {
            if *first.key() >= number {
                return;
            }
            let (epoch, mut open) = first.remove_entry();
            let length_ns = self.sources.length_ns;
            let start_ns = epoch.saturating_mul(length_ns);
            let is_shaken = |begin_ns: &i64| {
                *begin_ns < start_ns.saturating_add(length_ns)
                    && start_ns < begin_ns.saturating_add(SETTLED_AFTER_NS)
            };
            let has_values = open.quantities.iter().any(|sums| sums.count > 0);
            if has_values && self.earthquakes.iter().any(is_shaken) {
                open.quantities.fill(Sums::default());
                *self.refused.entry("shaken-epochs").or_default() += 1;
            }
            let sums = &open.quantities;
            let middle_ns = start_ns.saturating_add(length_ns / 2);
            let conditions = self.conditions.iter_mut();
            let conditions = conditions.map(|values| values.at(epoch, start_ns));
            closed.push(ClosedEpoch {
                middle_ns,
                epoch: Epoch {
                    time_s: ClosedEpoch::time_s(middle_ns),
                    quantities: sums.iter().map(Sums::value).collect(),
                    conditions: conditions.collect(),
                },
                deviations: sums.iter().map(Sums::deviation).collect(),
                is_measured: open.is_measured,
            });
            self.closed = Some(epoch);
        }
    }
}

impl Sums {
    fn add(&mut self, mean: f64, std: f64) {
        if self.count == 0 {
            self.first = mean.ln();
        }
        let log = mean.ln() - self.first;
        self.count += 1;
        self.log += log;
        self.square += log * log;
        self.variance += (std / mean).powi(2);
    }

    /// Returns the geometric mean of the estimates.
    fn value(&self) -> Option<f64> {
        let value = (self.first + self.log / f64::from(self.count)).exp();
        (self.count > 0 && value.is_finite() && value > 0.0).then_some(value)
    }

    /// Returns the standard deviation of ln(value): successive estimates depend on the same data,
    /// so their mean is not more certain than one of them.
    fn deviation(&self) -> Option<f64> {
        let count = f64::from(self.count);
        let between = self.square / count - (self.log / count).powi(2);
        let deviation = (self.variance / count + between.max(0.0)).sqrt();
        (self.count > 0 && deviation.is_finite()).then_some(deviation)
    }
}

impl ConditionSource {
    /// Converts a value to the unit of the judgement. Returns `None` if the units do not match.
    fn value(&self, display: &ConditionDisplay) -> Option<f64> {
        let (unit, value) = (display.unit.as_str(), display.value);
        match self.kind {
            ConditionKind::Amplitude | ConditionKind::Other { .. } => Some(value),
            ConditionKind::Celsius if unit == "degC" => Some(value),
            ConditionKind::Kelvin if unit == "K" => Some(value),
            ConditionKind::Celsius if unit == "K" => Some(value - KELVIN_OF_0_CELSIUS),
            ConditionKind::Kelvin if unit == "degC" => Some(value + KELVIN_OF_0_CELSIUS),
            ConditionKind::Fahrenheit if unit == "degC" => Some(1.8 * value + 32.0),
            ConditionKind::Fahrenheit if unit == "K" => {
                Some(1.8 * (value - KELVIN_OF_0_CELSIUS) + 32.0)
            }
            ConditionKind::Celsius | ConditionKind::Kelvin | ConditionKind::Fahrenheit => None,
        }
    }
}

impl ConditionValues {
    /// Forgets the values of the epochs from `first` on, if the newest value is later than a time
    /// (ns). It would exclude the values before it.
    fn forget_after(&mut self, latest_ns: i64, first: i64) {
        if self.newest_ns > Some(latest_ns) {
            self.newest_ns = None;
            self.by_epoch.retain(|number, _| *number < first);
        }
    }

    /// Returns the mean value in an epoch, or the last one before it if that still holds at its
    /// start. Drops values that later epochs do not need.
    fn at(&mut self, epoch: i64, start_ns: i64) -> Option<f64> {
        let (number, mean) = self.by_epoch.range(..=epoch).next_back()?;
        let (number, mean) = (*number, *mean);
        self.by_epoch = self.by_epoch.split_off(&number);
        if number == epoch {
            return Some(mean.sum / f64::from(mean.count));
        }
        (start_ns.saturating_sub(mean.last_ns) <= mean.holds_ns).then_some(mean.last)
    }
}

#[cfg(test)]
mod tests;
