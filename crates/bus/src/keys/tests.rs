use super::*;

fn keys() -> Keys {
    Keys::parse("spandrel", "tower").unwrap()
}

#[test]
fn keys_are_those_of_the_design_table() {
    let (keys, n) = (keys(), Name::new("storey-1").unwrap());
    let expected = [
        (keys.samples(&n), "spandrel/tower/sensor/storey-1/samples"),
        (keys.frames(), "spandrel/tower/frames"),
        (keys.estimates(), "spandrel/tower/estimates"),
        (keys.buffer(&n), "spandrel/tower/sensor/storey-1/@buffer"),
        (keys.recording(), "spandrel/tower/@recording"),
        (keys.estimates_buffer(), "spandrel/tower/@estimates"),
        (keys.parameter(&n), "spandrel/tower/parameter/storey-1"),
        (keys.all_parameters(), "spandrel/tower/parameter/*"),
        (keys.loss(&n), "spandrel/tower/loss/storey-1"),
        (keys.all_losses(), "spandrel/tower/loss/*"),
        (keys.noise(&n), "spandrel/tower/noise/storey-1"),
        (keys.all_noise(), "spandrel/tower/noise/*"),
        (keys.model_class(), "spandrel/tower/model-class"),
        (keys.fit(), "spandrel/tower/fit"),
        (keys.local(&n), "spandrel/tower/local/storey-1"),
        (keys.all_local(), "spandrel/tower/local/*"),
        (keys.feedback(&n), "spandrel/tower/feedback/storey-1"),
        (keys.node(&n), "spandrel/tower/node/storey-1"),
        (keys.all_nodes(), "spandrel/tower/node/*"),
        (keys.outlier(&n), "spandrel/tower/outlier/storey-1"),
        (keys.all_outliers(), "spandrel/tower/outlier/*"),
        (
            keys.sensor_health(&n),
            "spandrel/tower/sensor/storey-1/health",
        ),
        (keys.all_sensor_health(), "spandrel/tower/sensor/*/health"),
        (keys.waveform(&n), "spandrel/tower/sensor/storey-1/waveform"),
        (keys.spectrum(&n), "spandrel/tower/sensor/storey-1/spectrum"),
        (keys.condition(&n), "spandrel/tower/condition/storey-1"),
        (keys.all_conditions(), "spandrel/tower/condition/*"),
        (keys.epoch(&n), "spandrel/tower/epoch/storey-1"),
        (keys.all_epochs(), "spandrel/tower/epoch/*"),
        (keys.judgement(&n), "spandrel/tower/judgement/storey-1"),
        (keys.all_judgements(), "spandrel/tower/judgement/*"),
        (
            keys.judgement_course(&n),
            "spandrel/tower/judgement/storey-1/@course",
        ),
        (
            keys.all_judgement_courses(),
            "spandrel/tower/judgement/*/@course",
        ),
        (keys.report(&n), "spandrel/tower/@report/storey-1"),
        (keys.all_reports(), "spandrel/tower/@report/*"),
        (keys.mode(&n), "spandrel/tower/mode/storey-1"),
        (keys.all_modes(), "spandrel/tower/mode/*"),
        (keys.event(), "spandrel/tower/event"),
        (keys.all_alerts(), "spandrel/tower/alert/*"),
        (
            keys.all_acknowledgements(),
            "spandrel/tower/alert/*/acknowledge",
        ),
        (
            keys.status(Service::Fuse, &n),
            "spandrel/tower/status/fuse/storey-1",
        ),
        (keys.statuses(Service::Fuse), "spandrel/tower/status/fuse/*"),
        (keys.all_statuses(), "spandrel/tower/status/*/*"),
        (
            keys.all_live(Service::Sensor),
            "spandrel/tower/live/sensor/*",
        ),
        (keys.all_leaders(), "spandrel/tower/leader/identify/*"),
        (keys.description(), "spandrel/tower/description"),
        (keys.all_history(), "spandrel/tower/history/*"),
        (keys.alert(&n), "spandrel/tower/alert/storey-1"),
        (
            keys.acknowledge(&n),
            "spandrel/tower/alert/storey-1/acknowledge",
        ),
        (
            keys.progress(Service::Identify),
            "spandrel/tower/progress/identify",
        ),
        (
            keys.live(Service::Ingest, &n),
            "spandrel/tower/live/ingest/storey-1",
        ),
        (keys.history(&n), "spandrel/tower/history/storey-1"),
        (keys.history_log(), "spandrel/tower/@history-log"),
        (keys.alert_log(), "spandrel/tower/@alert-log"),
        (keys.judgement_log(), "spandrel/tower/@judgement-log"),
        (keys.leader(&n), "spandrel/tower/leader/identify/storey-1"),
        (keys.state(), "spandrel/tower/@state"),
        (keys.maintenance(), "spandrel/tower/maintenance"),
        (keys.annotation(), "spandrel/tower/annotation"),
        (keys.simulated(&n), "spandrel/tower/simulated/storey-1"),
        (keys.all_simulated(), "spandrel/tower/simulated/*"),
    ];
    for (found, expected) in expected {
        assert_eq!(found, expected);
        let is_known = parse_key(keys.root(), &found).is_some();
        assert_eq!(is_known, !found.contains('*'), "{found}");
    }
}

#[test]
fn each_key_is_parsed_back_to_its_family_and_item() {
    let (keys, n) = (keys(), Name::new("n-1").unwrap());
    for family in KeyFamily::all() {
        let has_items = family.pattern().contains("{of}");
        let key = keys.key(family, &n);
        let topic = Topic {
            family,
            of: has_items.then(|| n.clone()),
        };
        let parsed = parse_key(keys.root(), &key);
        assert_eq!(parsed, Some((keys.structure().clone(), topic)), "{key}");
    }
}

#[test]
fn no_two_families_share_a_key() {
    let (keys, n) = (keys(), Name::new("n-1").unwrap());
    let all: std::collections::BTreeSet<String> = KeyFamily::all()
        .map(|family| keys.key(family, &n))
        .collect();
    assert_eq!(all.len(), KeyFamily::all().count());
    let statuses = KeyFamily::Status(Service::Fuse)
        .expression_of_all_services(keys.root(), Some(keys.structure()));
    assert_eq!(statuses, Some(keys.all_statuses()));
}

#[test]
fn foreign_keys_are_not_parsed() {
    let root = Name::new("spandrel").unwrap();
    for key in ["spandrel", "spandrel/tower", "other/tower/frames", ""] {
        assert_eq!(parse_key(&root, key), None, "{key}");
    }
    assert_eq!(parse_key(&root, "spandrelx/tower/frames"), None);
    assert_eq!(parse_key(&root, "spandrel/tower/progress/nobody"), None);
}
