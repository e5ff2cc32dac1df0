//! Acknowledgements of alerts and of lasting losses.

use super::{DEADLINE, JUDGE, Site, name};
use serde_json::json;
use spandrel_bus::{
    Acknowledgement, AlertState, Annotation, AnnotationEffect, ChangeSeen, Event, EventKind,
    JudgementDisplay, JudgementLog, LossChange,
};
use spandrel_dashboard::{Listen, PageSettings};
use spandrel_service::{EventPublisher, ServiceInstance};

#[tokio::test(flavor = "multi_thread")]
async fn acknowledgement_is_published_with_name_and_note() {
    let site = Site::start().await;
    let heard = site
        .bus
        .subscribe::<Acknowledgement>(site.keys.all_acknowledgements(), 8)
        .await
        .unwrap();
    site.acknowledge("storey-2", "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(409, "the alert of storey-2 is not known");
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    let sent = site
        .acknowledge("storey-2", "", r#"{"who":" Ada ","note":"on my way"}"#)
        .await;
    assert_eq!(
        (sent.status, sent.json()),
        (202, json!({"sent": true, "state": null})),
        "nobody has answered"
    );
    let (key, found) = tokio::time::timeout(DEADLINE, heard.messages().recv_async())
        .await
        .unwrap()
        .unwrap();
    assert_eq!(key, site.keys.acknowledge(&name("storey-2")));
    assert_eq!(
        (found.who.as_str(), found.note.as_str()),
        ("Ada", "on my way")
    );
    let taking = async {
        heard.messages().recv_async().await.unwrap();
        site.raise(AlertState::Acknowledged).await;
    };
    let (sent, ()) = tokio::join!(site.acknowledge("storey-2", "", r#"{"who":"Ada"}"#), taking);
    assert_eq!(
        (sent.status, sent.json()),
        (200, json!({"sent": true, "state": "acknowledged"}))
    );
    site.acknowledge("storey-2", "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(409, "is acknowledged");
    assert!(heard.messages().is_empty(), "what is refused is not sent");
    site.end().await;
}

/// Regression test: a request for the alerts just after the confirmation still returned the raised
/// state.
#[tokio::test(flavor = "multi_thread")]
async fn confirmed_acknowledgement_is_in_the_alerts_at_once() {
    let site = Site::start().await;
    let heard = site
        .bus
        .subscribe::<Acknowledgement>(site.keys.all_acknowledgements(), 8)
        .await
        .unwrap();
    for _ in 0..5 {
        site.raise(AlertState::Raised).await;
        site.wait("an alarm", |found| found["raised"] == 1).await;
        let taking = async {
            heard.messages().recv_async().await.unwrap();
            site.raise(AlertState::Acknowledged).await;
        };
        let (sent, ()) = tokio::join!(
            site.acknowledge("storey-2", "", r#"{"who":"Ada","note":"seen"}"#),
            taking
        );
        assert_eq!(sent.status, 200);
        let alerts = site.get("/api/alerts").await.json();
        let standing = &alerts["standing"][0];
        assert_eq!(
            (&standing["state"], &standing["note"]),
            (&json!("acknowledged"), &json!("seen")),
            "{alerts}"
        );
        assert_eq!(
            site.get("/api/alerts?state=raised").await.json()["standing"],
            json!([])
        );
    }
    site.end().await;
}

/// Regression test: the interface reported the acknowledgement as sent although the router dropped
/// it.
#[tokio::test(flavor = "multi_thread")]
async fn error_names_the_roles_if_the_router_would_drop_an_acknowledgement() {
    let why = "role dashboard may not acknowledge; roles that may: server, operator";
    let listen = Listen::At("127.0.0.1:0".into()).into();
    let page = PageSettings {
        cannot_acknowledge: Some(why.to_owned()),
        ..listen
    };
    let site = Site::of(page, JUDGE).await;
    let heard = site
        .bus
        .subscribe::<Acknowledgement>(site.keys.all_acknowledgements(), 8)
        .await
        .unwrap();
    site.raise(AlertState::Raised).await;
    site.wait("an alarm", |found| found["raised"] == 1).await;
    site.acknowledge("storey-2", "", r#"{"who":"Ada"}"#)
        .await
        .expect_refused(403, why);
    assert!(heard.messages().is_empty());
    site.annotate("", r#"{"kind":"other","text":"x","who":"Ada"}"#)
        .await
        .expect_refused(403, why);
    site.end().await;
}

/// Returns the judgement of storey 2, which has lost 5 % of its stiffness.
fn lasting_loss() -> JudgementDisplay {
    let text = r#"{"structure":"demo","quantity":"storey-2","time_ns":9,"day_ns":0,"epoch_ns":8,
        "epochs":96,"measured":true,"state":"judged","change":{"kind":"lasting-loss","found_ns":0,
        "since_ns":0,"loss":0.05,"interval":{"level":0.95,"low":0.04,"high":0.06}},
        "sentence":"storey-2 has lost 5.0 % of stiffness (95 % interval 4.0 to 6.0 %).",
        "expectation":null,"false_alarms_per_year":0.1}"#;
    serde_json::from_str(text).unwrap()
}

/// Returns the changes that the service judge has kept: the loss was found and acknowledged.
fn past_of_the_loss() -> JudgementLog {
    let mut changes = Vec::new();
    LossChange::note(&mut changes, &lasting_loss());
    let seen = JudgementDisplay {
        seen: Some(ChangeSeen {
            who: "Ada".to_owned(),
            text: "on my way".to_owned(),
            time_ns: 10,
        }),
        ..lasting_loss()
    };
    LossChange::note(&mut changes, &seen);
    JudgementLog {
        structure: name("demo"),
        changes,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn lasting_loss_is_an_alert_that_is_acknowledged_as_an_annotation() {
    let site = Site::of(Listen::At("127.0.0.1:0".into()).into(), JUDGE).await;
    let about = site.get("/api/structures/demo").await.json()["about"].clone();
    assert_eq!(about["judge"]["false_alarms_per_year"], 0.1);
    assert_eq!(about["judge"]["commissioning_days"], 365);
    let key = site.keys.judgement(&name("storey-2"));
    let judgements = site.bus.publish_display(key).await.unwrap();
    let key = site.keys.annotation();
    let heard = site.bus.subscribe::<Annotation>(key, 8).await.unwrap();
    let events = EventPublisher::declare(&site.bus, &site.keys)
        .await
        .unwrap();
    let path = "/api/structures/demo/judgements/storey-2/acknowledge";
    let json_body = "Content-Type: application/json\r\n";
    let body = r#"{"who":"Ada","note":"on my way"}"#;
    site.request("POST", path, json_body, body)
        .await
        .expect_refused(409, "no lasting loss of storey-2 is known");
    judgements.put(&lasting_loss()).await.unwrap();
    let found = site.wait("an alarm", |found| found["raised"] == 1).await;
    assert_eq!(found["level"], "alarm");
    assert_eq!(found["last_alert"]["kind"], "lasting-loss");
    let alerts = site.get("/api/alerts?state=raised").await.json();
    let alert = &alerts["standing"][0];
    assert_eq!(
        (&alert["kind"], &alert["parameter"]),
        (&json!("lasting-loss"), &json!("storey-2"))
    );
    let none = site.get("/api/alerts?state=acknowledged").await.json();
    assert_eq!(none["standing"], json!([]));
    let change = &alerts["changes"][0];
    assert_eq!(change["kind"], "lasting-loss");
    assert_eq!(change["why"], alert["why"]);
    let past = past_of_the_loss();
    let key = site.keys.judgement_log();
    let questions = site.bus.questions(key.clone(), 8).await.unwrap();
    let answering = tokio::spawn(async move {
        while let Some(question) = questions.next().await {
            question.answer(&key, &past).await.unwrap();
        }
    });

    let instance = ServiceInstance::new(&site.bus, name("judge"));
    let judge = spandrel_bus::Service::Judge;
    let token = instance.announce(judge, &site.keys).await.unwrap();
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
    let sending = async {
        loop {
            let sent = site.request("POST", path, json_body, body).await;
            if sent.status != 503 {
                return sent;
            }
        }
    };
    let (sent, annotation) = tokio::join!(sending, keeping);
    assert_eq!(
        (sent.status, sent.json()),
        (200, json!({"sent": true, "state": "acknowledged"}))
    );
    assert_eq!(
        (
            annotation.effect,
            annotation.quantity.clone(),
            annotation.why()
        ),
        (
            AnnotationEffect::Seen,
            Some(name("storey-2")),
            "Ada: on my way".to_owned()
        )
    );
    // The past comes from the service judge.
    let asking = async {
        loop {
            let alerts = site.get("/api/alerts").await.json();
            if alerts["changes"].as_array().map(Vec::len) == Some(2) {
                return alerts["changes"].clone();
            }
            tokio::task::yield_now().await;
        }
    };
    let changes = tokio::time::timeout(DEADLINE, asking).await.unwrap();
    assert_eq!(changes[0]["state"], "acknowledged");
    assert_eq!(changes[0]["acknowledged_by"], "Ada");
    assert_eq!(changes[1]["state"], "raised");
    answering.abort();
    drop(token);
    site.end().await;
}
