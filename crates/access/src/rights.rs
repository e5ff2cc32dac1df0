//! The rights of each role: what it may do, and on which keys. No other module defines rights.

use spandrel_bus::{KeyFamily, Service};

use crate::role::Role;
use KeyFamily as K;

/// An operation on a key.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Right {
    /// Publish messages.
    Put,
    /// Receive messages that others publish.
    Subscribe,
    /// Send queries and receive the replies.
    Query,
    /// Receive queries and reply to them.
    Answer,
    /// Hold a liveliness token.
    Announce,
    /// Observe the liveliness tokens of others.
    Watch,
}

impl Right {
    /// All rights.
    pub const ALL: [Self; 6] = [
        Self::Put,
        Self::Subscribe,
        Self::Query,
        Self::Answer,
        Self::Announce,
        Self::Watch,
    ];

    /// Returns the name of the right in lower case.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Put => "put",
            Self::Subscribe => "subscribe",
            Self::Query => "query",
            Self::Answer => "answer",
            Self::Announce => "announce",
            Self::Watch => "watch",
        }
    }
}

/// Key families of data that the dashboard and the history show.
const DISPLAYED: [KeyFamily; 15] = [
    K::Parameter,
    K::Loss,
    K::Noise,
    K::Outlier,
    K::SensorHealth,
    K::Condition,
    K::Judgement,
    K::Mode,
    K::ModelClass,
    K::Fit,
    K::Monitoring,
    K::Node,
    K::Alert,
    K::Acknowledge,
    K::Event,
];

/// Key families that the services of a worker publish.
const IDENTIFIED: [KeyFamily; 15] = [
    K::Frames,
    K::Estimates,
    K::Parameter,
    K::Noise,
    K::Outlier,
    K::SensorHealth,
    K::ModelClass,
    K::Fit,
    K::Node,
    K::Feedback,
    K::Event,
    K::Description,
    K::Mode,
    K::Waveform,
    K::Spectrum,
];

/// Returns the rights of a role.
///
/// Some keys contain names of structures or nodes. A party whose scope is one structure or node has
/// its rights only on keys with its own name.
#[must_use]
pub fn rights(role: Role) -> Vec<(Right, KeyFamily)> {
    let mut all = match role {
        Role::Router | Role::Database => Vec::new(),
        Role::Server => [
            Role::Gateway,
            Role::Worker,
            Role::Alert,
            Role::History,
            Role::Notify,
            Role::Operator,
        ]
        .map(rights)
        .concat(),
        Role::Worker => of_worker(),
        Role::Alert => of_alert(),
        Role::History => of_history(),
        Role::Notify => of_notify(),
        Role::Viewer => of_viewer(),
        // The page exports samples, which it queries from ingest.
        Role::Dashboard => [
            rights(Role::Viewer),
            each(Right::Query, &[K::Recording]),
            of_service(Service::Dashboard),
        ]
        .concat(),
        Role::Operator => [
            rights(Role::Dashboard),
            each(Right::Put, &[K::Acknowledge, K::Maintenance, K::Annotation]),
        ]
        .concat(),
        // The publisher of a replayed or simulated record waits for its readers and queries the
        // last sample that ingest has stored.
        // A feed also publishes conditions, reports gaps of its instruments as events, and
        // publishes its own status. The history states which conditions it has stored.
        Role::Gateway => [
            rights(Role::Sensor),
            each(Right::Query, &[K::Recording, K::History]),
            each(Right::Put, &[K::Event, K::Condition]),
            each(Right::Answer, &[K::Condition]),
            of_service(Service::Feed),
        ]
        .concat(),
        // Waveforms and spectra are those of the node's own samples.
        Role::NodeWorker => [
            each(Right::Subscribe, &[K::Samples, K::Feedback]),
            each(Right::Query, &[K::Buffer]),
            each(Right::Put, &[K::Local, K::Event, K::Waveform, K::Spectrum]),
            of_service(Service::Identify),
        ]
        .concat(),
        Role::Sensor => [
            each(Right::Put, &[K::Samples]),
            each(Right::Answer, &[K::Buffer]),
            each(Right::Announce, &[K::Live(Service::Sensor), K::Simulated]),
            progress(Right::Subscribe),
            watch_all(),
        ]
        .concat(),
    };
    all.sort_unstable();
    all.dedup();
    all
}

/// Returns the rights of a process that aligns samples and identifies.
fn of_worker() -> Vec<(Right, KeyFamily)> {
    [
        each(
            Right::Subscribe,
            &[K::Samples, K::Frames, K::Local, K::Feedback],
        ),
        each(Right::Put, &IDENTIFIED),
        each(Right::Query, &[K::Buffer, K::Recording, K::State]),
        each(
            Right::Answer,
            &[K::Recording, K::EstimatesBuffer, K::Description, K::State],
        ),
        // Workers elect their leader among themselves.
        vec![(Right::Announce, K::Leader), (Right::Watch, K::Leader)],
        each(
            Right::Put,
            &[
                Service::Ingest,
                Service::Identify,
                Service::Fuse,
                Service::Modes,
            ]
            .map(K::Progress),
        ),
        progress(Right::Subscribe),
        // This status shows whether samples are waiting for identification, and hence when
        // identification becomes overloaded.
        each(Right::Subscribe, &[K::Status(Service::Ingest)]),
        watch_all(),
        [
            Service::Ingest,
            Service::Identify,
            Service::Fuse,
            Service::Modes,
            Service::Reports,
        ]
        .map(of_service)
        .concat(),
        // Reports of earthquakes need the frames, and state the open alerts and lasting losses.
        each(Right::Answer, &[K::Report]),
        each(Right::Subscribe, &[K::Alert, K::Judgement]),
        each(Right::Query, &[K::Alert]),
    ]
    .concat()
}

/// Returns the rights of a process that decides on alerts and judges lasting change.
fn of_alert() -> Vec<(Right, KeyFamily)> {
    [
        each(Right::Subscribe, &[K::Estimates, K::Acknowledge]),
        // This status names nodes with a wrong clock, and this comparison faulty sensors.
        each(
            Right::Subscribe,
            &[K::Status(Service::Ingest), K::SensorHealth],
        ),
        each(
            Right::Put,
            &[
                K::Alert,
                K::Loss,
                K::Monitoring,
                K::Event,
                K::Progress(Service::Alert),
            ],
        ),
        each(Right::Query, &[K::EstimatesBuffer]),
        each(Right::Answer, &[K::Alert, K::AlertLog]),
        of_service(Service::Alert),
        // The judgement is the slow part of the decision.
        each(
            Right::Subscribe,
            &[K::Parameter, K::Mode, K::Condition, K::Monitoring],
        ),
        each(Right::Subscribe, &Service::ALL.map(K::Status)),
        each(Right::Query, &[K::Alert, K::Condition]),
        each(
            Right::Watch,
            &[
                K::Live(Service::Alert),
                K::Live(Service::Feed),
                K::Live(Service::Sensor),
                K::Simulated,
            ],
        ),
        each(Right::Subscribe, &[K::Annotation]),
        // An event states that an earthquake begins.
        each(Right::Subscribe, &[K::Event]),
        each(Right::Put, &[K::Epoch, K::Judgement]),
        each(Right::Answer, &[K::JudgementCourse, K::JudgementLog]),
        of_service(Service::Judge),
    ]
    .concat()
}

/// Returns the rights of a process that stores the past.
fn of_history() -> Vec<(Right, KeyFamily)> {
    [
        each(Right::Subscribe, &DISPLAYED),
        // A feed states its latest conditions.
        each(Right::Query, &[K::Alert, K::AlertLog, K::Condition]),
        each(
            Right::Watch,
            &[K::Live(Service::Alert), K::Live(Service::Feed)],
        ),
        each(Right::Answer, &[K::History, K::HistoryLog]),
        // Events about its database.
        each(Right::Put, &[K::Event]),
        of_service(Service::History),
    ]
    .concat()
}

/// Returns the rights of a process that notifies people.
fn of_notify() -> Vec<(Right, KeyFamily)> {
    [
        each(
            Right::Subscribe,
            &[K::Alert, K::Judgement, K::Monitoring, K::Maintenance],
        ),
        // The status of ingest and of fuse states whether the samples are live.
        each(Right::Subscribe, &Service::ALL.map(K::Status)),
        // An event names the report of an earthquake, to which notices link.
        each(Right::Subscribe, &[K::Event]),
        each(Right::Put, &[K::Event]),
        each(Right::Query, &[K::Alert, K::AlertLog]),
        each(
            Right::Watch,
            &[
                K::Live(Service::Alert),
                K::Live(Service::Sensor),
                K::Simulated,
            ],
        ),
        of_service(Service::Notify),
    ]
    .concat()
}

/// Returns the rights of a process or person that reads results.
fn of_viewer() -> Vec<(Right, KeyFamily)> {
    [
        each(Right::Subscribe, &DISPLAYED),
        // After a restart, the progress of ingest separates replayed data from new data.
        each(
            Right::Subscribe,
            &[
                K::Estimates,
                K::Description,
                K::Progress(Service::Ingest),
                K::Waveform,
                K::Spectrum,
                K::Epoch,
            ],
        ),
        each(Right::Subscribe, &Service::ALL.map(K::Status)),
        each(
            Right::Query,
            &[
                K::Alert,
                K::Condition,
                K::Description,
                K::History,
                K::HistoryLog,
                K::JudgementCourse,
                K::JudgementLog,
                K::Report,
            ],
        ),
        watch_all(),
    ]
    .concat()
}

/// Returns a right on each of these families.
fn each(right: Right, families: &[KeyFamily]) -> Vec<(Right, KeyFamily)> {
    families.iter().map(|family| (right, *family)).collect()
}

/// Returns the rights by which every service reports its state.
fn of_service(service: Service) -> Vec<(Right, KeyFamily)> {
    vec![
        (Right::Put, K::Status(service)),
        (Right::Announce, K::Live(service)),
    ]
}

fn watch_all() -> Vec<(Right, KeyFamily)> {
    each(Right::Watch, &Service::ALL.map(K::Live))
}

fn progress(right: Right) -> Vec<(Right, KeyFamily)> {
    each(right, &Service::ALL.map(K::Progress))
}

/// Returns `true` if the name in the keys of a family is the name of a node.
///
/// A party of one node then has this right only on keys with its own name.
#[must_use]
pub fn is_of_node(right: Right, family: KeyFamily) -> bool {
    match family {
        K::Samples | K::Buffer | K::Local | K::Feedback | K::Waveform | K::Spectrum => true,
        // A node announces itself but watches all others.
        K::Live(_) | K::Status(_) | K::Simulated => matches!(right, Right::Announce | Right::Put),
        K::Frames
        | K::Recording
        | K::Estimates
        | K::EstimatesBuffer
        | K::Parameter
        | K::Loss
        | K::Noise
        | K::ModelClass
        | K::Fit
        | K::Monitoring
        | K::Node
        | K::Outlier
        | K::SensorHealth
        | K::Condition
        | K::Epoch
        | K::Judgement
        | K::JudgementCourse
        | K::Report
        | K::Mode
        | K::Event
        | K::Alert
        | K::Acknowledge
        | K::Maintenance
        | K::Annotation
        | K::Progress(_)
        | K::Leader
        | K::State
        | K::Description
        | K::History
        | K::HistoryLog
        | K::AlertLog
        | K::JudgementLog => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn may(role: Role, right: Right, family: KeyFamily) -> bool {
        rights(role).contains(&(right, family))
    }

    #[test]
    fn only_sensors_servers_and_gateways_publish_samples() {
        let putters: Vec<Role> = Role::ALL
            .into_iter()
            .filter(|role| may(*role, Right::Put, K::Samples))
            .collect();
        // A server can run the feed.
        assert_eq!(putters, [Role::Server, Role::Gateway, Role::Sensor]);
    }

    #[test]
    fn only_the_roles_of_a_feed_publish_conditions() {
        let publishers = Role::ALL.into_iter();
        let publishers = publishers.filter(|role| may(*role, Right::Put, K::Condition));
        assert_eq!(
            publishers.collect::<Vec<_>>(),
            [Role::Server, Role::Gateway]
        );
    }

    #[test]
    fn reading_roles_publish_only_their_own_status_and_operators_also_acknowledgements() {
        let put = |role: Role| {
            rights(role)
                .into_iter()
                .filter(|(right, _)| *right == Right::Put)
                .map(|(_, family)| family)
                .collect::<Vec<_>>()
        };
        assert_eq!(put(Role::Viewer), []);
        assert_eq!(put(Role::Dashboard), [K::Status(Service::Dashboard)]);
        assert_eq!(
            put(Role::Operator),
            [
                K::Acknowledge,
                K::Maintenance,
                K::Annotation,
                K::Status(Service::Dashboard)
            ]
        );
    }

    #[test]
    fn only_alert_and_the_server_decide_alerts() {
        let deciders: Vec<Role> = Role::ALL
            .into_iter()
            .filter(|role| may(*role, Right::Put, K::Alert))
            .collect();
        assert_eq!(deciders, [Role::Server, Role::Alert]);
    }

    #[test]
    fn waveforms_are_of_ingest_or_of_the_worker_of_the_node_itself() {
        let publishers = Role::ALL.into_iter();
        let publishers = publishers.filter(|role| may(*role, Right::Put, K::Waveform));
        assert_eq!(
            publishers.collect::<Vec<_>>(),
            [Role::Server, Role::Worker, Role::NodeWorker]
        );
        assert!(is_of_node(Right::Put, K::Waveform) && is_of_node(Right::Put, K::Spectrum));
    }

    #[test]
    fn sensor_receives_no_data_of_other_sensors() {
        for family in [K::Samples, K::Frames, K::Estimates, K::Local] {
            assert!(!may(Role::Sensor, Right::Subscribe, family), "{family:?}");
        }
        assert!(!may(Role::Sensor, Right::Query, K::Recording));
    }
}
