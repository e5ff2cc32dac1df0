//! The state of a structure: on the overview, in its own reply, and in a late dashboard.

use super::{Client, Site, name};
use serde_json::json;
use spandrel_bus::AlertState;
use spandrel_dashboard::{DashboardPlan, DashboardService, Listen};
use spandrel_service::{Monitored, Service as _, ServiceInstance};
use spandrel_structure::Structure;
use std::path::Path;
use tokio::sync::oneshot;

#[tokio::test(flavor = "multi_thread")]
async fn values_on_the_bus_appear_in_the_overview_and_in_the_structure() {
    let site = Site::start().await;
    assert_eq!(
        site.get("/api/structures").await.json()["structures"][0]["level"],
        "learning"
    );
    site.put(5, 0.85).await;
    site.raise(AlertState::Raised).await;
    let seen = site
        .wait("an alarm", |found| {
            found["level"] == "alarm" && !found["worst"].is_null()
        })
        .await;
    assert_eq!(seen["worst"]["parameter"], "storey-2");
    assert_eq!(seen["sentence"], "storey-2 <b>has lost</b> 15 %");
    let whole = site.get("/api/structures/demo").await.json();
    assert_eq!(
        whole["about"]["drawing"]["members"]
            .as_array()
            .unwrap()
            .len(),
        5
    );
    assert_eq!(whole["standing"]["parameters"]["storey-2"]["mean"], 0.85);
    assert_eq!(
        whole["standing"]["series"],
        json!(["parameter/storey-2", "loss/storey-2"])
    );
    let alerts = site.get("/api/alerts?state=raised").await.json();
    assert_eq!(alerts["standing"][0]["parameter"], "storey-2");
    assert!(
        site.get("/api/alerts?state=cleared").await.json()["standing"]
            .as_array()
            .unwrap()
            .is_empty()
    );
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn late_dashboard_queries_the_state_of_the_alerts() {
    let site = Site::start().await;
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let structure = Structure::read(&path).unwrap();
    let plan = DashboardPlan {
        instance: ServiceInstance::new(&site.bus, name("late")),
        structures: vec![Monitored::new(&structure, site.keys.clone())],
        page: Listen::At("127.0.0.1:0".into()).into(),
    };
    let late = DashboardService::start(&plan).await.unwrap();
    let client = Client {
        address: late.address(),
    };
    let (stop, stopped) = oneshot::channel::<()>();
    let running = tokio::spawn(late.run(Box::pin(async {
        let _ = stopped.await;
    })));
    client
        .wait("the alarm that was there before", |found| {
            found["raised"] == 1
        })
        .await;
    stop.send(()).unwrap();
    running.await.unwrap().unwrap();
    site.end().await;
}
