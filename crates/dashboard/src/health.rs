//! Health checks for service managers and monitoring.

use crate::server::Server;
use crate::store::Store;
use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde_json::json;
use spandrel_bus::Service;
use std::sync::Arc;

/// Paths that require no token. Their replies contain no structure name.
pub(crate) const LIVE_PATH: &str = "/health/live";
pub(crate) const READY_PATH: &str = "/health/ready";

/// Replies as long as the process runs.
pub(crate) async fn live() -> Response {
    Json(json!({"live": true})).into_response()
}

/// Reports whether each structure has the services that turn samples into alerts, or into natural
/// frequencies if it has no model.
pub(crate) async fn ready(State(server): State<Arc<Server>>) -> Response {
    let (mut structures, mut missing) = (0_u64, 0_u64);
    for store in server.stores() {
        structures += 1;
        missing += u64::from(!has_all(&store));
    }
    let code = if missing == 0 {
        StatusCode::OK
    } else {
        StatusCode::SERVICE_UNAVAILABLE
    };
    let answer =
        json!({"ready": missing == 0, "structures": structures, "without-a-service": missing});
    (code, Json(answer)).into_response()
}

/// Returns `true` if all required services are present.
///
/// Estimates come from ingest and identify, or in distributed identification from the station.
fn has_all(store: &Store) -> bool {
    let has = |wanted: Service| store.state.has(wanted);
    if !store.about.is_filtered {
        return has(Service::Ingest) && has(Service::Modes);
    }
    let estimates = has(Service::Fuse) || (has(Service::Ingest) && has(Service::Identify));
    estimates && has(Service::Alert)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{demo, present, sensors_only};

    #[test]
    fn structure_without_a_model_is_ready_with_its_frequencies() {
        let mut store = sensors_only();
        store.handle(present(&[(Service::Ingest, "one")]));
        assert!(!has_all(&store));
        let both = [(Service::Ingest, "one"), (Service::Modes, "one")];
        store.handle(present(&both));
        assert!(has_all(&store));
    }

    #[test]
    fn structure_is_ready_with_all_services_of_one_arrangement() {
        let ready = |services: &[Service]| {
            let mut store = demo();
            let services: Vec<_> = services.iter().map(|service| (*service, "one")).collect();
            store.handle(present(&services));
            has_all(&store)
        };
        assert!(ready(&[Service::Ingest, Service::Identify, Service::Alert]));
        assert!(ready(&[Service::Fuse, Service::Alert]));
        for lacking in [
            &[Service::Ingest, Service::Identify][..],
            &[Service::Identify, Service::Alert],
            &[Service::Fuse],
            &[],
        ] {
            assert!(!ready(lacking), "{lacking:?}");
        }
    }
}
