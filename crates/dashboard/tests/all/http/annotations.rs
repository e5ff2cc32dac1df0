//! Annotations of the judged quantities.

use super::{JUDGE, Site, name};
use serde_json::json;
use spandrel_bus::{Annotation, AnnotationEffect, AnnotationKind, Event, EventKind, time_ns};
use spandrel_dashboard::Listen;
use spandrel_service::{EventPublisher, ServiceInstance};

#[tokio::test(flavor = "multi_thread")]
async fn annotation_is_published_and_confirmed_by_the_service_judge() {
    let site = Site::of(Listen::At("127.0.0.1:0".into()).into(), JUDGE).await;
    let key = site.keys.annotation();
    let heard = site.bus.subscribe::<Annotation>(key, 8).await.unwrap();
    let events = EventPublisher::declare(&site.bus, &site.keys)
        .await
        .unwrap();
    let keeping = async {
        let (_, annotation) = heard.messages().recv_async().await.unwrap();
        let event = Event {
            structure: name("demo"),
            time_ns: annotation.from_ns,
            kind: EventKind::Annotation,
            subject: "storey-2".to_owned(),
            what: annotation.what(),
            why: annotation.why(),
        };
        events.put(&event).await.unwrap();
        annotation
    };
    let body = r#"{"kind":"repair","text":"new bearings","who":" Ada ","quantity":"storey-2",
        "effect":"new-reference","from":"2025-01-01"}"#;
    site.annotate("", body)
        .await
        .expect_refused(503, "the service judge does not run");
    let instance = ServiceInstance::new(&site.bus, name("judge"));
    let judge = spandrel_bus::Service::Judge;
    let token = instance.announce(judge, &site.keys).await.unwrap();
    let sending = async {
        loop {
            let sent = site.annotate("", body).await;
            if sent.status != 503 {
                return sent;
            }
        }
    };
    let (sent, annotation) = tokio::join!(sending, keeping);
    assert_eq!(
        (sent.status, sent.json()),
        (200, json!({"sent": true, "kept": true}))
    );
    let expected = Annotation {
        structure: name("demo"),
        quantity: Some(name("storey-2")),
        time_ns: annotation.time_ns,
        from_ns: time_ns("2025-01-01").unwrap(),
        to_ns: None,
        kind: AnnotationKind::Repair,
        effect: AnnotationEffect::NewReference,
        who: "Ada".to_owned(),
        text: "new bearings".to_owned(),
    };
    assert_eq!(annotation, expected);

    let refused = async |body: &str, status: u16, told: &str| {
        let answer = site.annotate("", body).await;
        answer.expect_refused(status, told);
    };
    refused(
        r#"{"kind":"other","text":" ","who":"Ada"}"#,
        400,
        "text is empty",
    )
    .await;
    refused(
        r#"{"kind":"other","text":"x","who":"Ada","from":"2200-01-01"}"#,
        400,
        "from is in the future",
    )
    .await;
    refused(
        r#"{"kind":"party","text":"x","who":"Ada"}"#,
        422,
        "unknown variant `party`",
    )
    .await;
    let huge = format!(
        r#"{{"kind":"other","text":"{}","who":"Ada"}}"#,
        "a".repeat(20_000)
    );
    refused(&huge, 413, "").await;
    let other = "Origin: https://example.org\r\n";
    site.annotate(other, body)
        .await
        .expect_refused(403, "another site");
    assert!(heard.messages().is_empty(), "what is refused is not sent");
    drop(token);
    site.end().await;
}
