//! The configuration of a site's router: its certificates and the rights of each party.
//!
//! Zenoh identifies a party by the common name of its certificate. It allows a message if its key
//! expression lies within a key expression of a rule. Messages from a party arrive at the router
//! (ingress), and messages to a party leave it (egress). The rules restrict both directions.

use std::collections::BTreeSet;
use std::path::Path;

use serde_json::{Value, json};
use spandrel_bus::{AROUND_THE_PAYLOAD, KeyFamily, MAX_MESSAGE_BYTES, Name, Service, in_order};

use crate::error::AccessError;
use crate::rights::{Right, is_of_node, rights};
use crate::role::{Party, Role};

/// Maximum number of concurrent sessions. The router rejects further ones.
const MAX_SESSIONS: usize = 1_000;
/// Maximum number of sessions that may be opening at the same time.
const MAX_OPENING: usize = 64;

/// Contents of a router's configuration file.
#[derive(Clone, Debug)]
pub struct RouterPlan<'p> {
    /// First chunk of all keys.
    pub root: &'p Name,
    /// Identity of the router.
    pub router: &'p Party,
    /// Endpoints on which the router listens, `quic/…`.
    pub listen: &'p [String],
    /// Endpoints of other routers of the site to connect to, `quic/…`.
    pub connect: &'p [String],
    /// Path of the router's certificate.
    pub certificate: &'p Path,
    /// Path of the private key of that certificate.
    pub key: &'p Path,
    /// Path of the authority's certificate.
    pub authority: &'p Path,
    /// All holders of a certificate.
    ///
    /// Other routers get the right to forward what their own parties may do. Parties without rights
    /// on the bus get no rules.
    pub parties: &'p [Party],
}

/// Returns the configuration file of a router, in the format of `zenohd` and `spandrel router`.
///
/// # Errors
/// An endpoint is not `quic/…`, or a path is not UTF-8.
pub fn router_file(plan: &RouterPlan<'_>) -> Result<String, AccessError> {
    if let Some(endpoint) = plan
        .listen
        .iter()
        .chain(plan.connect)
        .find(|endpoint| !endpoint.starts_with("quic/"))
    {
        return Err(AccessError::PlainEndpoint {
            endpoint: endpoint.clone(),
        });
    }
    let (certificate, key, authority) = (
        text(plan.certificate)?,
        text(plan.key)?,
        text(plan.authority)?,
    );
    let in_order = |endpoints: &[String]| {
        endpoints
            .iter()
            .map(|endpoint| in_order(endpoint))
            .collect::<Vec<_>>()
    };
    let largest = MAX_MESSAGE_BYTES + AROUND_THE_PAYLOAD;
    let mut config = json!({
        "mode": "router",
        "listen": { "endpoints": in_order(plan.listen) },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
        "adminspace": { "enabled": false },
        "transport": {
            "unicast": { "max_sessions": MAX_SESSIONS, "accept_pending": MAX_OPENING },
            "link": {
                "protocols": ["quic"],
                "rx": { "max_message_size": largest },
                "tls": {
                    "root_ca_certificate": authority,
                    "listen_certificate": certificate,
                    "listen_private_key": key,
                    "connect_certificate": certificate,
                    "connect_private_key": key,
                    "enable_mtls": true,
                    "verify_name_on_connect": true,
                    "close_link_on_expiration": true,
                },
            },
        },
        "low_pass_filter": [{
            "id": "no larger than a message",
            "flows": ["ingress"],
            "messages": ["put", "delete", "query", "reply"],
            "key_exprs": all_keys(plan.root),
            "size_limit": MAX_MESSAGE_BYTES,
        }],
        "access_control": access_control(plan.root, plan.router, plan.parties),
    });
    if !plan.connect.is_empty() {
        config["connect"] = json!({ "endpoints": in_order(plan.connect) });
    }
    // Serialising a map of JSON values cannot fail.
    let config = serde_json::to_string_pretty(&config).unwrap_or_default();
    Ok(format!(
        "// Router of a Spandrel site, written by `spandrel site router`; write it anew rather than change it.\n\
         // Everybody shows a certificate of the authority; what is not allowed below is refused.\n\
         {config}\n"
    ))
}

fn text(path: &Path) -> Result<&str, AccessError> {
    path.to_str().ok_or_else(|| AccessError::PathNotText {
        path: path.to_owned(),
    })
}

/// An access rule of Zenoh for one subject.
struct Rule {
    id: String,
    messages: Vec<&'static str>,
    flows: Vec<&'static str>,
    keys: Vec<String>,
}

impl Rule {
    fn json(&self) -> Value {
        json!({
            "id": self.id,
            "permission": "allow",
            "flows": self.flows,
            "messages": self.messages,
            "key_exprs": self.keys,
        })
    }
}

fn access_control(root: &Name, router: &Party, parties: &[Party]) -> Value {
    let mut rules = vec![known_to_all(root)];
    let (mut subjects, mut policies) = (Vec::new(), Vec::new());
    let others = |party: &&Party| party.role() == Role::Router && *party != router;
    let routers: Vec<String> = parties
        .iter()
        .filter(others)
        .map(Party::common_name)
        .collect();
    if !routers.is_empty() {
        rules.push(between_routers(root));
        policies.push(json!({ "id": BETWEEN_ROUTERS, "rules": [BETWEEN_ROUTERS], "subjects": [BETWEEN_ROUTERS] }));
        subjects.push(json!({ "id": BETWEEN_ROUTERS, "cert_common_names": routers }));
    }
    let on_the_bus = |party: &&Party| !rights(party.role()).is_empty();
    for party in parties.iter().filter(on_the_bus).collect::<BTreeSet<_>>() {
        let of_party = rules_of(root, party);
        let name = party.common_name();
        let ids: Vec<&str> = std::iter::once(KNOWN_TO_ALL)
            .chain(of_party.iter().map(|rule| rule.id.as_str()))
            .collect();
        policies.push(json!({ "id": name, "rules": ids, "subjects": [name] }));
        subjects.push(json!({ "id": name, "cert_common_names": [name] }));
        rules.extend(of_party);
    }
    if subjects.is_empty() {
        // Without subjects, Zenoh would also deny everything, but it would log a warning.
        subjects.push(json!({ "id": "nobody", "cert_common_names": ["nobody"] }));
        policies.push(json!({ "id": "nobody", "rules": [KNOWN_TO_ALL], "subjects": ["nobody"] }));
    }
    json!({
        "enabled": true,
        "default_permission": "deny",
        "rules": rules.iter().map(Rule::json).collect::<Vec<_>>(),
        "subjects": subjects,
        "policies": policies,
    })
}

const KNOWN_TO_ALL: &str = "who is there to read and to answer";

/// Returns the rule that reveals subscribers and queryables to all parties.
///
/// Publishers need to know whether anyone subscribes, and clients need to know whether anyone
/// replies. The key expressions are not secret.
fn known_to_all(root: &Name) -> Rule {
    Rule {
        id: KNOWN_TO_ALL.to_owned(),
        messages: vec!["declare_subscriber", "declare_queryable"],
        flows: vec!["egress"],
        keys: all_keys(root),
    }
}

const BETWEEN_ROUTERS: &str = "between routers";

/// Returns the rule that allows other routers everything that parties may do, in both directions.
///
/// Each router checks its own parties, and the other routers rely on that check.
fn between_routers(root: &Name) -> Rule {
    let mut messages: Vec<&'static str> = Vec::new();
    for right in Right::ALL {
        let (arriving, leaving) = self::messages(right);
        for message in arriving.into_iter().chain(leaving) {
            if !messages.contains(&message) {
                messages.push(message);
            }
        }
    }
    Rule {
        id: BETWEEN_ROUTERS.to_owned(),
        messages,
        flows: vec!["ingress", "egress"],
        keys: all_keys(root),
    }
}

/// Returns key expressions that match every key below the root.
///
/// `**` does not match chunks that begin with `@`, so keys with such chunks are listed separately.
fn all_keys(root: &Name) -> Vec<String> {
    let families = KeyFamily::all()
        .into_iter()
        .map(|family| family.expression(root, None, None));
    let mut keys = vec![format!("{root}/**")];
    keys.extend(families.filter(|key| key.contains("/@")));
    keys
}

/// Returns the Zenoh messages of a right: those that arrive at the router, and those that leave it.
fn messages(right: Right) -> (Vec<&'static str>, Vec<&'static str>) {
    match right {
        Right::Put => (vec!["put"], vec![]),
        Right::Subscribe => (vec!["declare_subscriber"], vec!["put"]),
        Right::Query => (vec!["query"], vec!["reply"]),
        Right::Answer => (vec!["declare_queryable", "reply"], vec!["query"]),
        Right::Announce => (vec!["liveliness_token"], vec![]),
        Right::Watch => (
            vec!["declare_liveliness_subscriber", "liveliness_query"],
            vec!["liveliness_token"],
        ),
    }
}

fn rules_of(root: &Name, party: &Party) -> Vec<Rule> {
    let mut rules = Vec::new();
    for right in Right::ALL {
        let keys = keys_of(root, party, right);
        if keys.is_empty() {
            continue;
        }
        let (arriving, leaving) = messages(right);
        for (flow, messages) in [("ingress", arriving), ("egress", leaving)] {
            if !messages.is_empty() {
                let id = format!("{} {} {flow}", party.common_name(), right.as_str());
                rules.push(Rule {
                    id,
                    messages,
                    flows: vec![flow],
                    keys: keys.clone(),
                });
            }
        }
    }
    rules
}

/// Returns the key expressions on which a party has a right.
#[must_use]
pub fn keys_of(root: &Name, party: &Party, right: Right) -> Vec<String> {
    let families: Vec<KeyFamily> = rights(party.role())
        .into_iter()
        .filter(|(of, _)| *of == right)
        .map(|(_, family)| family)
        .collect();
    let structure = party.structure();
    let mut keys = BTreeSet::new();
    for family in &families {
        let node = party.node().filter(|_| is_of_node(right, *family));
        keys.insert(family.expression(root, structure, node));
        // A party that reads all services uses one key expression for them. No key expression of a
        // single service contains it.
        let of_each: [fn(Service) -> KeyFamily; 3] =
            [KeyFamily::Progress, KeyFamily::Status, KeyFamily::Live];
        let has_all = |of: fn(Service) -> KeyFamily| {
            Service::ALL
                .iter()
                .all(|service| families.contains(&of(*service)))
                && Service::ALL.iter().any(|service| of(*service) == *family)
        };
        if node.is_none() && of_each.into_iter().any(has_all) {
            keys.extend(family.expression_of_all_services(root, structure));
        }
    }
    keys.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn root() -> Name {
        Name::new("spandrel").unwrap()
    }

    fn keys(party: &str, right: Right) -> Vec<String> {
        keys_of(&root(), &party.parse().unwrap(), right)
    }

    #[test]
    fn a_sensor_has_its_own_keys_only() {
        assert_eq!(
            keys("sensor.tower.roof", Right::Put),
            ["spandrel/tower/sensor/roof/samples"]
        );
        assert_eq!(
            keys("sensor.tower.roof", Right::Answer),
            ["spandrel/tower/sensor/roof/@buffer"]
        );
        assert_eq!(
            keys("sensor.tower.roof", Right::Announce),
            ["spandrel/tower/live/sensor/roof"]
        );
        assert_eq!(
            keys("gateway.tower", Right::Put),
            ["spandrel/tower/sensor/*/samples"]
        );
    }

    #[test]
    fn who_watches_all_services_may_ask_for_all_at_once() {
        assert!(keys("viewer.ada", Right::Watch).contains(&"spandrel/*/live/*/*".to_owned()));
        assert!(keys("viewer.ada", Right::Subscribe).contains(&"spandrel/*/status/*/*".to_owned()));
        assert_eq!(
            keys("notify.main", Right::Watch),
            ["spandrel/*/live/alert/*"]
        );
    }

    #[test]
    fn a_router_listens_with_certificates_only() {
        let listen = ["tcp/0.0.0.0:7447".to_owned()];
        let error = written(&listen, &[], &[]).unwrap_err().to_string();
        assert!(
            error.contains("tcp/0.0.0.0:7447") && error.contains("quic/"),
            "{error}"
        );
        let error = written(&["quic/0.0.0.0:7447".to_owned()], &listen, &[])
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("tcp/0.0.0.0:7447") && error.contains("quic/"),
            "{error}"
        );
    }

    /// Returns the file of router `north` with these parties.
    fn written(
        listen: &[String],
        connect: &[String],
        parties: &[&str],
    ) -> Result<String, AccessError> {
        let (path, root, router) = (Path::new("a.pem"), root(), "router.north".parse().unwrap());
        let parties: Vec<Party> = parties.iter().map(|party| party.parse().unwrap()).collect();
        let plan = RouterPlan {
            root: &root,
            router: &router,
            listen,
            connect,
            certificate: path,
            key: path,
            authority: path,
            parties: &parties,
        };
        router_file(&plan)
    }

    fn config(text: &str) -> Value {
        let json: String = text
            .lines()
            .filter(|line| !line.starts_with("//"))
            .collect();
        serde_json::from_str(&json).unwrap()
    }

    #[test]
    fn routers_of_a_site_pass_on_to_each_other_and_a_router_alone_admits_none() {
        let (listen, other) = (
            ["quic/10.0.0.5:7447".to_owned()],
            ["quic/10.0.0.6:7447".to_owned()],
        );
        let parties = [
            "router.north",
            "router.south",
            "viewer.ada",
            "database.main",
        ];
        let joined = config(&written(&listen, &other, &parties).unwrap());
        assert_eq!(
            joined["connect"]["endpoints"],
            json!(["quic/10.0.0.6:7447?multistream=0"])
        );
        let names = |config: &Value| -> Vec<Value> {
            let subjects = config["access_control"]["subjects"]
                .as_array()
                .unwrap()
                .clone();
            subjects
                .into_iter()
                .map(|subject| subject["cert_common_names"].clone())
                .collect()
        };
        assert_eq!(
            names(&joined),
            [json!(["router.south"]), json!(["viewer.ada"])],
            "and no database"
        );
        let rule = &joined["access_control"]["rules"][1];
        assert_eq!(
            (&rule["id"], &rule["flows"]),
            (&json!("between routers"), &json!(["ingress", "egress"]))
        );
        assert!(
            !rule["messages"]
                .as_array()
                .unwrap()
                .contains(&json!("delete")),
            "nobody may delete"
        );
        let alone = config(&written(&listen, &[], &["router.north", "viewer.ada"]).unwrap());
        assert_eq!(names(&alone), [json!(["viewer.ada"])]);
        assert!(alone.get("connect").is_none());
    }
}
