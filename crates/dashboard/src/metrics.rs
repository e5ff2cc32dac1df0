//! Metrics for Prometheus at `GET /metrics`.

use crate::conditions::conditions;
use crate::overview::overview;
use crate::sensors::sensor_states;
use crate::server::now_ns;
use crate::store::Store;
use crate::view::{judgements, modes};
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;
use spandrel_bus::{
    AlertState, ChangeKind, FitReason, FitVerdict, JudgementState, ModeState, MonitoringState,
    UndecidedBecause,
};
use spandrel_service::Refused;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::AtomicU64;

/// Content type of the reply, OpenMetrics.
pub(crate) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(&'static str, String)>;
type Gauges = Family<Labels, Gauge<f64, AtomicU64>>;
type Counters = Family<Labels, Counter>;

/// All metrics of one reply.
#[derive(Default)]
struct Metrics {
    mean: Gauges,
    std: Gauges,
    reference: Gauges,
    probability: Gauges,
    noise: Gauges,
    noise_std: Gauges,
    alert: Gauges,
    monitoring: Gauges,
    channel_used_share: Gauges,
    fit: Gauges,
    fit_reason: Gauges,
    undecided: Gauges,
    plausibility: Gauges,
    rejected: Counters,
    rejected_share: Gauges,
    sensor: Gauges,
    fault: Gauges,
    offset: Gauges,
    clock_quality: Gauges,
    node_distance: Gauges,
    condition: Gauges,
    condition_age: Gauges,
    judgement: Gauges,
    lasting_loss: Gauges,
    evidence: Gauges,
    judged_epoch: Gauges,
    mode_state: Gauges,
    mode_frequency: Gauges,
    mode_frequency_std: Gauges,
    mode_damping: Gauges,
    mode_damping_std: Gauges,
    mode_machine: Gauges,
    mode_epoch: Gauges,
    time: Gauges,
    age: Gauges,
    lag: Gauges,
    behind: Gauges,
    done: Counters,
    dropped: Counters,
    restarts: Counters,
    refused: Counters,
    up: Gauges,
}

/// Writes the metrics of all structures, and the number of refusals by kind.
///
/// # Errors
/// None in practice, because writing to a string cannot fail.
pub(crate) fn metrics<'s>(
    stores: impl Iterator<Item = impl std::ops::Deref<Target = Store> + 's>,
    refusals: &BTreeMap<Refused, u64>,
) -> Result<String, fmt::Error> {
    let metrics = Metrics::default();
    // A counter exists before its first refusal, because a rate needs two values.
    for refused in Refused::ALL {
        let labels = vec![("reason", refused.as_str().to_owned())];
        let count = refusals.get(&refused).copied().unwrap_or(0);
        metrics.refused.get_or_create(&labels).inc_by(count);
    }
    stores.for_each(|store| metrics.add(&store));
    let mut text = String::new();
    encode(&mut text, &metrics.registry())?;
    Ok(text)
}

impl Metrics {
    fn registry(&self) -> Registry {
        let mut registry = Registry::with_prefix("spandrel");
        let mut gauge =
            |name: &str, help: &str, gauges: &Gauges| registry.register(name, help, gauges.clone());
        gauge(
            "parameter_mean",
            "Estimate of a parameter, ratio to nominal",
            &self.mean,
        );
        gauge(
            "parameter_std",
            "Standard deviation of the estimate, ratio to nominal",
            &self.std,
        );
        gauge(
            "parameter_reference",
            "Reference of the loss, ratio to nominal",
            &self.reference,
        );
        gauge(
            "parameter_probability_of_loss",
            "Probability of a loss larger than the loss of the rule",
            &self.probability,
        );
        gauge(
            "noise_variance",
            "Noise level, a variance in the square of its unit",
            &self.noise,
        );
        gauge(
            "noise_variance_std",
            "Standard deviation of the noise level",
            &self.noise_std,
        );
        gauge(
            "alert_state",
            "1 for the state of the alert, 0 for the other states",
            &self.alert,
        );
        gauge(
            "alert_monitoring_state",
            "1 for the state of the monitoring, 0 for the others",
            &self.monitoring,
        );
        gauge(
            "alert_channel_used_share",
            "Share of the samples of the last 5 s that the filter has used",
            &self.channel_used_share,
        );
        gauge(
            "identify_fit_verdict",
            "1 for the verdict on the fit, 0 for the others",
            &self.fit,
        );
        gauge(
            "identify_fit_reason",
            "1 for a reason why the fit is not supported, 0 for the others",
            &self.fit_reason,
        );
        gauge(
            "alert_undecided",
            "1 for the reason why a parameter is undecided, 0 for the others",
            &self.undecided,
        );
        gauge(
            "model_class_plausibility",
            "Plausibility of a model class",
            &self.plausibility,
        );
        gauge(
            "channel_rejected_share",
            "Share of rejected samples among the recent samples of a channel",
            &self.rejected_share,
        );
        gauge(
            "sensor_alive",
            "1 if a channel delivers samples that are used",
            &self.sensor,
        );
        gauge(
            "sensor_fault_probability",
            "Probability that a channel is faulty, by comparison with the others",
            &self.fault,
        );
        gauge(
            "sensor_sampling_offset_seconds",
            "Time from the frames to the samples of a channel, which are interpolated",
            &self.offset,
        );
        gauge(
            "sensor_clock_quality_ratio",
            "Quality of the clock of the node of a channel, as its source states it",
            &self.clock_quality,
        );
        gauge(
            "node_distance",
            "Distance of a distributed node from the others",
            &self.node_distance,
        );
        gauge(
            "condition_value",
            "Latest value of a condition, such as a temperature, in its unit",
            &self.condition,
        );
        gauge(
            "condition_age_seconds",
            "Time since the latest value of a condition was measured",
            &self.condition_age,
        );
        gauge(
            "judgement_state",
            "1 for the state or the lasting change of a judged quantity, 0 for the others",
            &self.judgement,
        );
        gauge(
            "judgement_loss",
            "Lasting loss of stiffness that was found, as a share; negative for a gain",
            &self.lasting_loss,
        );
        gauge(
            "judgement_evidence",
            "ln of the evidence of a lasting loss, divided by ln of its threshold",
            &self.evidence,
        );
        gauge(
            "judgement_epoch_seconds",
            "Middle of the last epoch, seconds since the Unix epoch",
            &self.judged_epoch,
        );
        gauge(
            "mode_state",
            "1 for the state of a declared mode, 0 for the others",
            &self.mode_state,
        );
        gauge(
            "mode_frequency_hertz",
            "Natural frequency of a declared mode in the last epoch",
            &self.mode_frequency,
        );
        gauge(
            "mode_frequency_std_hertz",
            "Standard deviation of the natural frequency",
            &self.mode_frequency_std,
        );
        gauge(
            "mode_damping_ratio",
            "Damping ratio of a declared mode in the last epoch",
            &self.mode_damping,
        );
        gauge(
            "mode_damping_std_ratio",
            "Standard deviation of the damping ratio",
            &self.mode_damping_std,
        );
        gauge(
            "mode_machine",
            "1 if a machine runs at the frequency of a declared mode, otherwise 0",
            &self.mode_machine,
        );
        gauge(
            "mode_epoch_seconds",
            "End of the last epoch of a declared mode, seconds since the Unix epoch",
            &self.mode_epoch,
        );
        gauge(
            "measured_time_seconds",
            "Time of the newest value, seconds since the Unix epoch",
            &self.time,
        );
        gauge(
            "measured_age_seconds",
            "Time since the last data of a structure was received",
            &self.age,
        );
        gauge(
            "lag_seconds",
            "Wall clock minus time of the last processed frame, by service, for live samples",
            &self.lag,
        );
        gauge(
            "frames_behind",
            "Frames that ingest has published and a service has not processed",
            &self.behind,
        );
        gauge("up", "1 if a service is alive", &self.up);
        registry.register(
            "channel_rejected",
            "Rejected samples of a channel",
            self.rejected.clone(),
        );
        registry.register(
            "frames_done",
            "Frames or messages that a service has processed",
            self.done.clone(),
        );
        registry.register(
            "dropped",
            "Items that a service has dropped, by reason",
            self.dropped.clone(),
        );
        registry.register("restarts", "Restarts of a filter", self.restarts.clone());
        registry.register(
            "refused",
            "Requests, connections and messages that this process refused",
            self.refused.clone(),
        );
        registry
    }

    fn add(&self, store: &Store) {
        self.add_estimates(store);
        self.add_alerts(store);
        self.add_monitoring(store);
        self.add_sensors(store);
        self.add_conditions(store);
        self.add_judgements(store);
        self.add_modes(store);
        self.add_services(store);
    }

    /// Adds parameters, losses, noise levels, the fit and the model classes.
    fn add_estimates(&self, store: &Store) {
        for (name, display) in &store.state.parameters {
            let name = name.as_str();
            set(store, &self.mean, "parameter", name, display.mean);
            set(store, &self.std, "parameter", name, display.std);
        }
        for (name, display) in &store.state.losses {
            let name = name.as_str();
            let probability = display.probability_of_loss;
            set(store, &self.reference, "parameter", name, display.reference);
            set(store, &self.probability, "parameter", name, probability);
        }
        for (name, display) in &store.state.noise {
            set(store, &self.noise, "name", name.as_str(), display.mean);
            set(store, &self.noise_std, "name", name.as_str(), display.std);
        }
        if let Some(display) = &store.state.fit {
            for verdict in FitVerdict::ALL {
                set(
                    store,
                    &self.fit,
                    "verdict",
                    verdict.as_str(),
                    f64::from(u8::from(display.verdict == verdict)),
                );
            }
            for reason in FitReason::ALL {
                let holds = display.reasons.iter().any(|found| found == reason);
                set(
                    store,
                    &self.fit_reason,
                    "reason",
                    reason.as_str(),
                    f64::from(u8::from(holds)),
                );
            }
        }
        for class in store
            .state
            .classes
            .iter()
            .flat_map(|display| &display.classes)
        {
            set(
                store,
                &self.plausibility,
                "class",
                &class.class,
                class.plausibility,
            );
        }
    }

    /// Adds the states of the alerts.
    fn add_alerts(&self, store: &Store) {
        for (parameter, alert) in &store.state.alerts {
            for state in AlertState::ALL {
                let labels = vec![
                    structure(store),
                    ("parameter", parameter.to_string()),
                    ("state", state.as_str().to_owned()),
                ];
                self.alert
                    .get_or_create(&labels)
                    .set(f64::from(u8::from(alert.state == state)));
            }
        }
        for (parameter, alert) in &store.state.alerts {
            for because in UndecidedBecause::ALL {
                let labels = vec![
                    structure(store),
                    ("parameter", parameter.to_string()),
                    ("reason", because.as_str().to_owned()),
                ];
                let holds = alert.undecided_because == Some(because);
                self.undecided
                    .get_or_create(&labels)
                    .set(f64::from(u8::from(holds)));
            }
        }
    }

    /// Adds the state of the monitoring.
    fn add_monitoring(&self, store: &Store) {
        // Without a report, nothing proves that damage would be noticed. Without a model, nobody
        // reports.
        let monitoring = store.state.monitoring();
        let state = monitoring.map_or(MonitoringState::Blind, |display| display.state);
        let reported = MonitoringState::ALL.into_iter();
        for other in reported.filter(|_| store.about.is_filtered) {
            set(
                store,
                &self.monitoring,
                "state",
                other.as_str(),
                f64::from(u8::from(other == state)),
            );
        }
        for channel in monitoring.iter().flat_map(|display| &display.channels) {
            set(
                store,
                &self.channel_used_share,
                "channel",
                channel.channel.as_str(),
                channel.used_share,
            );
        }
    }

    /// Adds channels, sensors and distributed nodes.
    fn add_sensors(&self, store: &Store) {
        for (channel, display) in &store.state.outliers {
            set(
                store,
                &self.rejected_share,
                "channel",
                channel.as_str(),
                display.recent_share,
            );
            self.rejected
                .get_or_create(&vec![structure(store), ("channel", channel.to_string())])
                .inc_by(display.rejected);
        }
        for sensor in sensor_states(store) {
            let labels = vec![
                structure(store),
                ("channel", sensor.channel),
                ("node", sensor.node),
            ];
            let delivers = f64::from(u8::from(sensor.health.delivers()));
            self.sensor.get_or_create(&labels).set(delivers);
            if let Some(compared) = sensor.compared {
                let probability = compared.probability;
                self.fault.get_or_create(&labels).set(probability);
            }
            let offset_s = sensor.clock.map_or(0.0, |clock| clock.offset_s);
            self.offset.get_or_create(&labels).set(offset_s);
            if let Some(percent) = sensor.clock.and_then(|clock| clock.quality_percent) {
                let quality = f64::from(percent) / 100.0;
                self.clock_quality.get_or_create(&labels).set(quality);
            }
        }
        for (node, display) in &store.state.nodes {
            set(
                store,
                &self.node_distance,
                "node",
                node.as_str(),
                display.distance.unwrap_or(f64::NAN),
            );
        }
    }

    /// Adds the conditions.
    fn add_conditions(&self, store: &Store) {
        for condition in conditions(store) {
            let labels = vec![
                structure(store),
                ("condition", condition.name.to_owned()),
                ("unit", condition.unit.to_owned()),
            ];
            if let (Some(value), Some(age_s)) = (condition.value, condition.age_s) {
                self.condition.get_or_create(&labels).set(value);
                self.condition_age.get_or_create(&labels).set(age_s);
            }
        }
    }

    /// Adds the judgements of lasting change.
    fn add_judgements(&self, store: &Store) {
        for view in judgements(store) {
            let display = view.display;
            let quantity = display.quantity.as_str();
            let states = JudgementState::ALL.map(JudgementState::as_str);
            for word in states
                .into_iter()
                .chain(ChangeKind::ALL.map(ChangeKind::as_str))
            {
                let labels = vec![
                    structure(store),
                    ("quantity", quantity.to_owned()),
                    ("state", word.to_owned()),
                ];
                let holds = f64::from(u8::from(word == view.word));
                self.judgement.get_or_create(&labels).set(holds);
            }
            for state in [AlertState::Raised, AlertState::Acknowledged] {
                let labels = vec![
                    structure(store),
                    ("quantity", quantity.to_owned()),
                    ("kind", ChangeKind::LastingLoss.as_str().to_owned()),
                    ("state", state.as_str().to_owned()),
                ];
                let holds = f64::from(u8::from(display.alert_state() == Some(state)));
                self.alert.get_or_create(&labels).set(holds);
            }
            if let Some(change) = &display.change {
                set(store, &self.lasting_loss, "quantity", quantity, change.loss);
            }
            if let Some(expectation) = &display.expectation {
                let share = expectation.ln_evidence / expectation.ln_threshold;
                set(store, &self.evidence, "quantity", quantity, share);
            }
            if let Some(epoch_ns) = display.epoch_ns {
                set(
                    store,
                    &self.judged_epoch,
                    "quantity",
                    quantity,
                    epoch_ns as f64 / 1e9,
                );
            }
        }
    }

    /// Adds the declared modes.
    fn add_modes(&self, store: &Store) {
        for display in modes(store) {
            let name = display.mode.as_str();
            for state in ModeState::ALL {
                let labels = vec![
                    structure(store),
                    ("mode", name.to_owned()),
                    ("state", state.as_str().to_owned()),
                ];
                let holds = f64::from(u8::from(state == display.state));
                self.mode_state.get_or_create(&labels).set(holds);
            }
            let machine = f64::from(u8::from(display.machine));
            set(store, &self.mode_machine, "mode", name, machine);
            set(
                store,
                &self.mode_epoch,
                "mode",
                name,
                display.time_ns as f64 / 1e9,
            );
            let Some(estimate) = &display.estimate else {
                continue;
            };
            for (gauges, value) in [
                (&self.mode_frequency, estimate.frequency_hz),
                (&self.mode_frequency_std, estimate.frequency_std_hz),
                (&self.mode_damping, estimate.damping),
                (&self.mode_damping_std, estimate.damping_std),
            ] {
                set(store, gauges, "mode", name, value);
            }
        }
    }

    /// Adds the times of the data and the states of the services.
    fn add_services(&self, store: &Store) {
        let whole = vec![structure(store)];
        let overview = overview(store);
        if let Some(time_s) = overview.time_s {
            self.time.get_or_create(&whole).set(time_s);
        }
        if let Some(age_s) = overview.age_s {
            self.age.get_or_create(&whole).set(age_s);
        }
        for (service, id) in &store.state.seen {
            let labels = vec![
                structure(store),
                ("service", service.as_str().to_owned()),
                ("id", id.to_string()),
            ];
            let is_there = store.state.is_present(*service, id);
            self.up
                .get_or_create(&labels)
                .set(f64::from(u8::from(is_there)));
        }
        for ((service, id), status) in store.state.statuses() {
            let labels = vec![
                structure(store),
                ("service", service.as_str().to_owned()),
                ("id", id.to_string()),
            ];
            if let Some(lag_s) = status.lag_s.filter(|_| store.state.has_lag()) {
                // The lag grows while the service publishes nothing.
                let silent_s = now_ns().saturating_sub(status.time_ns) as f64 / 1e9;
                self.lag
                    .get_or_create(&labels)
                    .set(lag_s + silent_s.max(0.0));
            }
            if let Some(behind) = status.frames_behind {
                self.behind.get_or_create(&labels).set(behind as f64);
            }
            self.done.get_or_create(&labels).inc_by(status.done);
            self.restarts.get_or_create(&labels).inc_by(status.restarts);
            for (reason, count) in &status.drops {
                let labels = labels
                    .iter()
                    .cloned()
                    .chain([("reason", reason.clone())])
                    .collect();
                self.dropped.get_or_create(&labels).inc_by(*count);
            }
        }
    }
}

/// Returns the label of a structure.
fn structure(store: &Store) -> (&'static str, String) {
    ("structure", store.about.name.clone())
}

/// Sets the value of a gauge for one item of a structure.
fn set(store: &Store, gauges: &Gauges, key: &'static str, of: &str, value: f64) {
    gauges
        .get_or_create(&vec![structure(store), (key, of.to_owned())])
        .set(value);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{
        air, alert, at, demo, demo_with_air, fit, hear, lasting_loss, mode, undecided,
    };
    use spandrel_listener::Input;

    #[test]
    fn estimates_and_alerts_are_exposed_as_openmetrics() {
        let mut store = demo();
        hear(&mut store, "storey-2", 5_000_000_000, 0.85, 0.997);
        store.handle(Input::Alert(alert(
            "storey-2",
            5_000_000_000,
            AlertState::Raised,
        )));
        let refusals = BTreeMap::from([(Refused::WrongToken, 40)]);
        let text = metrics(std::iter::once(&store), &refusals).unwrap();
        for line in [
            "spandrel_refused_total{reason=\"wrong-token\"} 40",
            "spandrel_refused_total{reason=\"bus-handshake\"} 0",
            "spandrel_parameter_mean{structure=\"demo\",parameter=\"storey-2\"} 0.85",
            "spandrel_parameter_probability_of_loss{structure=\"demo\",parameter=\"storey-2\"} \
             0.997",
            "spandrel_alert_state{structure=\"demo\",parameter=\"storey-2\",state=\"raised\"} 1.0",
            "spandrel_alert_state{structure=\"demo\",parameter=\"storey-2\",state=\"normal\"} 0.0",
            "spandrel_measured_time_seconds{structure=\"demo\"} 5.0",
        ] {
            assert!(text.lines().any(|found| found == line), "{line}\n{text}");
        }
        assert!(text.ends_with("# EOF\n"), "{text}");
    }

    #[test]
    fn a_condition_has_its_value_unit_and_age() {
        let mut store = demo_with_air();
        store.handle(at(5.0));
        store.handle(Input::Condition(air(5, 21.5)));
        store.handle(at(7.5));
        let text = metrics(std::iter::once(&store), &BTreeMap::new()).unwrap();
        let labels = "{structure=\"demo\",condition=\"air\",unit=\"degC\"}";
        for line in [
            format!("spandrel_condition_value{labels} 21.5"),
            format!("spandrel_condition_age_seconds{labels} 2.5"),
        ] {
            assert!(text.lines().any(|found| found == line), "{line}\n{text}");
        }
    }

    #[test]
    fn a_lasting_loss_has_its_state_size_and_evidence() {
        let mut store = demo_with_air();
        store.handle(Input::Judgement(lasting_loss("storey-2")));
        // The structure file does not judge this parameter.
        store.handle(Input::Judgement(lasting_loss("storey-1")));
        let text = metrics(std::iter::once(&store), &BTreeMap::new()).unwrap();
        let labels = "structure=\"demo\",quantity=\"storey-2\"";
        for line in [
            format!("spandrel_judgement_state{{{labels},state=\"lasting-loss\"}} 1.0"),
            format!("spandrel_judgement_state{{{labels},state=\"judged\"}} 0.0"),
            format!("spandrel_alert_state{{{labels},kind=\"lasting-loss\",state=\"raised\"}} 1.0"),
            format!(
                "spandrel_alert_state{{{labels},kind=\"lasting-loss\",state=\"acknowledged\"}} 0.0"
            ),
            format!("spandrel_judgement_loss{{{labels}}} 0.05"),
            format!("spandrel_judgement_evidence{{{labels}}} 1.125"),
            format!("spandrel_judgement_epoch_seconds{{{labels}}} 450.0"),
        ] {
            assert!(text.lines().any(|found| found == line), "{line}\n{text}");
        }
        assert!(!text.contains("quantity=\"storey-1\""), "{text}");
    }

    #[test]
    fn a_declared_mode_has_its_frequency_and_damping_with_their_deviations() {
        let mut store = demo_with_air();
        store.handle(Input::Mode(Box::new(mode("bending", 600))));
        // The structure file does not declare this mode.
        store.handle(Input::Mode(Box::new(mode("torsion", 600))));
        let text = metrics(std::iter::once(&store), &BTreeMap::new()).unwrap();
        let labels = "structure=\"demo\",mode=\"bending\"";
        for line in [
            format!("spandrel_mode_state{{{labels},state=\"tracked\"}} 1.0"),
            format!("spandrel_mode_state{{{labels},state=\"lost\"}} 0.0"),
            format!("spandrel_mode_frequency_hertz{{{labels}}} 1.25"),
            format!("spandrel_mode_frequency_std_hertz{{{labels}}} 0.01"),
            format!("spandrel_mode_damping_ratio{{{labels}}} 0.02"),
            format!("spandrel_mode_damping_std_ratio{{{labels}}} 0.002"),
            format!("spandrel_mode_machine{{{labels}}} 0.0"),
            format!("spandrel_mode_epoch_seconds{{{labels}}} 600.0"),
        ] {
            assert!(text.lines().any(|found| found == line), "{line}\n{text}");
        }
        assert!(!text.contains("torsion"), "{text}");
    }

    #[test]
    fn verdict_and_reasons_are_labels_of_closed_sets() {
        let mut store = demo();
        store.handle(fit(FitVerdict::Doubtful, &[FitReason::ExcessNoise]));
        store.handle(undecided(
            "storey-2",
            AlertState::Undecided,
            UndecidedBecause::NothingLearnt,
        ));
        let text = metrics(std::iter::once(&store), &BTreeMap::new()).unwrap();
        for line in [
            "spandrel_identify_fit_verdict{structure=\"demo\",verdict=\"doubtful\"} 1.0",
            "spandrel_identify_fit_verdict{structure=\"demo\",verdict=\"supported\"} 0.0",
            "spandrel_identify_fit_reason{structure=\"demo\",reason=\"excess-noise\"} 1.0",
            "spandrel_alert_state{structure=\"demo\",parameter=\"storey-2\",state=\"undecided\"} \
             1.0",
            "spandrel_alert_undecided{structure=\"demo\",parameter=\"storey-2\",reason=\"nothing-learnt\"} 1.0",
            "spandrel_alert_undecided{structure=\"demo\",parameter=\"storey-2\",reason=\"fit-contradicted\"} 0.0",
        ] {
            assert!(text.lines().any(|found| found == line), "{line}\n{text}");
        }
    }

    #[test]
    fn names_of_drop_reasons_are_escaped() {
        let mut store = demo();
        store.handle(Input::Status(spandrel_bus::Status {
            structure: crate::testing::name("demo"),
            service: crate::testing::name("ingest"),
            id: crate::testing::name("ingest"),
            time_ns: 0,
            lag_s: None,
            pace: None,
            load: None,
            frames_behind: None,
            fit: None,
            undecided: BTreeMap::new(),
            instruments: BTreeMap::new(),
            clocks: BTreeMap::new(),
            missing: BTreeMap::new(),
            maintenance: Vec::new(),
            state: None,
            done: 1,
            drops: [("a\"} 1\nspandrel_up 0 #".to_owned(), 3)].into(),
            restarts: 0,
            version: String::new(),
        }));
        let text = metrics(std::iter::once(&store), &BTreeMap::new()).unwrap();
        assert!(
            text.contains(r#"reason="a\"} 1\nspandrel_up 0 #"} 3"#),
            "{text}"
        );
        assert!(
            !text.lines().any(|line| line.starts_with("spandrel_up 0")),
            "{text}"
        );
    }
}
