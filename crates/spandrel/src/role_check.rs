//! Check that a process's certificate grants the rights that its subcommand needs.
//!
//! Without this check, a router would drop forbidden messages silently.

use crate::error::AppError;
use spandrel_access::{Party, Right, Role, rights};
use spandrel_bus::{Bus, BusConfig, KeyFamily, Service};
use tracing::warn;

/// A right that a subcommand needs, and its description.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Need {
    words: &'static str,
    right: Right,
    family: KeyFamily,
}

impl Need {
    const fn new(words: &'static str, right: Right, family: KeyFamily) -> Self {
        Self {
            words,
            right,
            family,
        }
    }

    pub const PUT_SAMPLES: Self = Self::new("publish samples", Right::Put, KeyFamily::Samples);
    pub const PUT_FRAMES: Self = Self::new("publish frames", Right::Put, KeyFamily::Frames);
    pub const PUT_ESTIMATES: Self =
        Self::new("publish estimates", Right::Put, KeyFamily::Estimates);
    pub const PUT_LOCAL: Self = Self::new(
        "publish the estimates of a node",
        Right::Put,
        KeyFamily::Local,
    );
    pub const PUT_FEEDBACK: Self =
        Self::new("publish feedback to nodes", Right::Put, KeyFamily::Feedback);
    pub const PUT_ALERTS: Self = Self::new("publish alerts", Right::Put, KeyFamily::Alert);
    pub const PUT_JUDGEMENTS: Self =
        Self::new("publish judgements", Right::Put, KeyFamily::Judgement);
    pub const PUT_MODES: Self =
        Self::new("publish natural frequencies", Right::Put, KeyFamily::Mode);
    pub const ANSWER_REPORTS: Self = Self::new(
        "answer queries for reports",
        Right::Answer,
        KeyFamily::Report,
    );
    pub const ANSWER_HISTORY: Self =
        Self::new("answer history queries", Right::Answer, KeyFamily::History);
    pub const NOTIFY: Self = Self::new(
        "announce notify",
        Right::Announce,
        KeyFamily::Live(Service::Notify),
    );
    pub const SHOW_A_PAGE: Self = Self::new(
        "announce a dashboard",
        Right::Announce,
        KeyFamily::Live(Service::Dashboard),
    );
    pub const READ_FRAMES: Self =
        Self::new("subscribe to frames", Right::Subscribe, KeyFamily::Frames);
    pub const ACKNOWLEDGE: Self = Self::new("acknowledge", Right::Put, KeyFamily::Acknowledge);
    pub const MAINTAIN: Self = Self::new("mute notices", Right::Put, KeyFamily::Maintenance);
    pub const ANNOTATE: Self = Self::new("annotate", Right::Put, KeyFamily::Annotation);
    pub const SEE_EVENTS: Self =
        Self::new("subscribe to events", Right::Subscribe, KeyFamily::Event);
    pub const SEE_STATUS: Self = Self::new(
        "subscribe to the status",
        Right::Subscribe,
        KeyFamily::Status(Service::Notify),
    );
    pub const SEE_PARAMETERS: Self = Self::new(
        "subscribe to parameters",
        Right::Subscribe,
        KeyFamily::Parameter,
    );
}

/// Task of a subcommand.
#[derive(Debug, Clone)]
pub struct Work<'w> {
    /// Name of the subcommand.
    pub subcommand: &'static str,
    /// Rights that the task needs.
    pub needs: &'w [Need],
    /// Structures of the task. If empty, the task concerns all existing structures.
    pub structures: Vec<&'w str>,
    /// Nodes of the task, if the subcommand acts for nodes.
    pub nodes: Vec<&'w str>,
}

/// Rejects a certificate that does not allow the task, if a router is reachable.
///
/// A router would drop forbidden messages. Peers do not enforce roles, so without a router this
/// function only logs a warning.
///
/// # Errors
/// [`AppError::WrongRole`], or the certificate cannot be read.
pub async fn check(bus: &Bus, config: &BusConfig, work: &Work<'_>) -> Result<(), AppError> {
    let Some(tls) = &config.tls else {
        return Ok(());
    };
    let Some(party) = Party::of_certificate(&tls.certificate)? else {
        return Ok(());
    };
    let Some(why) = objection(&party, work) else {
        return Ok(());
    };
    let certificate = tls.certificate.clone();
    if bus.reaches_a_router().await {
        return Err(AppError::WrongRole { certificate, why });
    }
    warn!(certificate = %certificate.display(), why, "a router of the site would drop the \
                                                      messages of this process");
    Ok(())
}

/// Returns the reason why a reachable router would drop acknowledgements of this process, or `None`
/// if it would not.
///
/// A page or view can work without this right. It reports the reason when a user tries to
/// acknowledge an alert, because nothing else would.
///
/// # Errors
/// Returns an error if the certificate cannot be read.
pub async fn cannot_acknowledge(bus: &Bus, config: &BusConfig) -> Result<Option<String>, AppError> {
    let Some(tls) = &config.tls else {
        return Ok(None);
    };
    let Some(party) = Party::of_certificate(&tls.certificate)? else {
        return Ok(None);
    };
    let why = lack(&party, &[Need::ACKNOWLEDGE], "");
    Ok(if why.is_some() && bus.reaches_a_router().await {
        why
    } else {
        None
    })
}

/// Returns the missing right of a party for `for_what` and the roles that have it, or `None` if no
/// right is missing.
fn lack(party: &Party, needs: &[Need], for_what: &str) -> Option<String> {
    let lacks = |role: Role| {
        let allowed = rights(role);
        needs
            .iter()
            .copied()
            .find(|need| !allowed.contains(&(need.right, need.family)))
    };
    let role = party.role();
    let need = lacks(role)?;
    let fitting: Vec<&str> = Role::ALL
        .into_iter()
        .filter(|role| lacks(*role).is_none())
        .map(Role::as_str)
        .collect();
    Some(format!(
        "role {role} may not {}{for_what}; roles that may: {}",
        need.words,
        fitting.join(", ")
    ))
}

/// Returns the reason why a party may not perform a task and the roles that may, or `None` if it
/// may.
fn objection(party: &Party, work: &Work<'_>) -> Option<String> {
    let subcommand = work.subcommand;
    if let Some(lack) = lack(
        party,
        work.needs,
        &format!(", which spandrel {subcommand} requires"),
    ) {
        return Some(format!("it belongs to {}, and {lack}", party.common_name()));
    }
    let own = party.structure()?.as_str();
    if let Some(other) = work.structures.iter().find(|structure| **structure != own) {
        return Some(format!(
            "it is for structure {own} only, but spandrel {subcommand} is for {other}"
        ));
    }
    let node = party.node()?.as_str();
    let others: Vec<&str> = work
        .nodes
        .iter()
        .copied()
        .filter(|name| *name != node)
        .collect();
    (!others.is_empty()).then(|| {
        format!(
            "it is for node {node} of {own} only, but spandrel {subcommand} also publishes for {}; \
             choose the node with --node {node}, or use a certificate of role gateway",
            others.join(", ")
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(party: &str, needs: &[Need], nodes: &[&str]) -> Option<String> {
        let work = Work {
            subcommand: "simulate",
            needs,
            structures: vec!["tower"],
            nodes: nodes.to_vec(),
        };
        objection(&party.parse().unwrap(), &work)
    }

    #[test]
    fn error_lists_the_roles_that_have_the_right() {
        let samples = [Need::PUT_SAMPLES];
        let why = "it belongs to viewer.ada, and role viewer may not publish samples, which \
                   spandrel simulate requires; roles that may: server, gateway, \
                   sensor";
        assert_eq!(
            told("viewer.ada", &samples, &["ground", "roof"]).as_deref(),
            Some(why)
        );
        assert_eq!(told("gateway.tower", &samples, &["ground", "roof"]), None);
        let all = [
            Need::PUT_FRAMES,
            Need::PUT_ESTIMATES,
            Need::PUT_ALERTS,
            Need::ANSWER_HISTORY,
            Need::SHOW_A_PAGE,
        ];
        assert!(
            told("worker.main", &all, &[])
                .unwrap()
                .ends_with("roles that may: server")
        );
        assert_eq!(told("server.main", &all, &[]), None);
        assert_eq!(told("worker.main", &all[..2], &[]), None);
    }

    #[test]
    fn error_lists_the_roles_that_may_acknowledge() {
        let lack = |party: &str| lack(&party.parse().unwrap(), &[Need::ACKNOWLEDGE], "");
        let why = "role dashboard may not acknowledge; roles that may: server, operator";
        assert_eq!(lack("dashboard.page").as_deref(), Some(why));
        assert_eq!((lack("operator.grace"), lack("server.main")), (None, None));
    }

    /// The page asks only for the right to acknowledge.
    #[test]
    fn a_role_that_may_acknowledge_may_annotate_and_hear_the_confirmation() {
        for role in Role::ALL {
            let allowed = rights(role);
            let may = |need: Need| allowed.contains(&(need.right, need.family));
            let both = may(Need::ANNOTATE) && may(Need::SEE_EVENTS);
            assert!(both || !may(Need::ACKNOWLEDGE), "{role}");
        }
    }

    #[test]
    fn certificate_is_valid_only_for_its_structure_or_node() {
        let samples = [Need::PUT_SAMPLES];
        assert!(
            told("gateway.bridge", &samples, &["ground"])
                .unwrap()
                .contains("for structure bridge only")
        );
        assert_eq!(told("sensor.tower.roof", &samples, &["roof"]), None);
        let why = told("sensor.tower.roof", &samples, &["ground", "roof"]).unwrap();
        assert!(
            why.contains("also publishes for ground; choose the node with --node roof"),
            "{why}"
        );
    }

    #[test]
    fn at_least_one_role_has_each_right() {
        for need in [
            Need::PUT_SAMPLES,
            Need::PUT_FRAMES,
            Need::PUT_ESTIMATES,
            Need::PUT_LOCAL,
            Need::PUT_FEEDBACK,
            Need::PUT_ALERTS,
            Need::ANSWER_HISTORY,
            Need::NOTIFY,
            Need::SHOW_A_PAGE,
            Need::ACKNOWLEDGE,
            Need::MAINTAIN,
            Need::SEE_STATUS,
            Need::SEE_PARAMETERS,
        ] {
            let met = Role::ALL
                .into_iter()
                .any(|role| rights(role).contains(&(need.right, need.family)));
            assert!(met, "{}", need.words);
        }
    }
}
