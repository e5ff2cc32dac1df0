//! Replies to wrong requests, the files of the page with their headers, and the address.

use super::{Site, name};
use spandrel_bus::AlertState;
use spandrel_dashboard::{DashboardPlan, DashboardService, Listen};
use spandrel_service::{Service as _, ServiceInstance};
use tokio::net::TcpListener;

#[tokio::test(flavor = "multi_thread")]
async fn errors_name_the_mistake_and_the_allowed_values() {
    let site = Site::start().await;
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    site.get("/api/structures/tower")
        .await
        .expect_refused(404, "structure `tower` is not known");
    site.get("/api/nothing")
        .await
        .expect_refused(404, "unknown path /api/nothing");
    site.request("POST", "/api/structures", "", "")
        .await
        .expect_refused(405, "does not support POST");
    let history = "/api/structures/demo/history";
    site.get(&format!("{history}?points=none"))
        .await
        .expect_refused(400, "points");
    site.get(&format!("{history}?until=5"))
        .await
        .expect_refused(400, "until");
    site.get(&format!("{history}?series=parameter/roof"))
        .await
        .expect_refused(400, "parameter/roof");
    site.get("/api/structures/demo/log?most=0")
        .await
        .expect_refused(400, "most is 0");
    site.get("/api/alerts?state=angry")
        .await
        .expect_refused(400, "angry");
    site.get("/api/live?structure=tower")
        .await
        .expect_refused(404, "tower");
    site.get("/api/live").await.expect_refused(400, "");
    site.acknowledge("roof", "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(404, "parameter `roof`");
    site.acknowledge("storey-2", "", r#"{"who":"  "}"#)
        .await
        .expect_refused(400, "who is empty");
    site.acknowledge("storey-2", "", r#"{"note":"x"}"#)
        .await
        .expect_refused(422, "who");
    site.acknowledge("storey-2", "", "{")
        .await
        .expect_refused(400, "");
    let long = format!(r#"{{"who":"{}"}}"#, "a".repeat(101));
    site.acknowledge("storey-2", "", &long)
        .await
        .expect_refused(400, "who is too long");
    let huge = format!(r#"{{"who":"Ada","note":"{}"}}"#, "a".repeat(20_000));
    site.acknowledge("storey-2", "", &huge)
        .await
        .expect_refused(413, "");
    let other = "Origin: https://example.org\r\n";
    site.acknowledge("storey-2", other, r#"{"who":"Ada"}"#)
        .await
        .expect_refused(403, "another site");
    let plain = "/api/structures/demo/alerts/storey-2/acknowledge";
    site.request("POST", plain, "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(415, "");
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn content_security_policy_allows_only_own_files() {
    let site = Site::start().await;
    let page = site.get("/").await;
    assert_eq!(page.status, 200);
    assert!(page.body.contains("<title>Spandrel</title>"));
    assert!(
        page.head
            .contains("content-security-policy: default-src 'none'; script-src 'self';"),
        "{}",
        page.head
    );
    assert!(page.head.contains("x-content-type-options: nosniff"));
    for (path, content) in [
        ("/app.js", "text/javascript"),
        ("/uplot.js", "text/javascript"),
        ("/style.css", "text/css"),
    ] {
        let file = site.get(path).await;
        assert!(
            file.status == 200 && file.head.contains(content),
            "{path}: {}",
            file.head
        );
    }
    site.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn requested_address_in_use_is_an_error() {
    let taken = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let site = Site::start().await;
    let plan = DashboardPlan {
        instance: ServiceInstance::new(&site.bus, name("other")),
        structures: Vec::new(),
        page: Listen::At(address.clone()).into(),
    };
    let failed = DashboardService::start(&plan).await;
    let told = failed.unwrap_err().to_string();
    assert!(told.contains(&address), "{told}");
    site.end().await;
}
