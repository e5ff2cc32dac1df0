//! Alerts that reach people who are not looking: a webhook, an Alertmanager and a mail server of the test itself.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails panics")]

mod support;

use serde_json::Value;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;
use support::{DEADLINE, Process, Site, spandrel, two_storeys};

/// Damage of storey 2 at 20 s; a rule against the design.
const DAMAGED: &str = "[[alert]]\nparameters = \"all\"\nloss = 0.05\ncredibility = 0.99\nsustain-s = 5\n\
                       [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = 20\nloss = 0.15\n";
const TOKEN: &str = "t0ken-of-the-test";
const PATH: &str = "/hooks/s3cret-path";

/// A request as it came: head and body.
struct Request {
    head: String,
    body: Value,
}

/// Answers HTTP requests, the first `failing` of them with an error.
fn http(failing: usize) -> (SocketAddr, Receiver<Request>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let (sender, requests) = channel();
    thread::spawn(move || {
        for (number, stream) in listener.incoming().enumerate() {
            let sender = sender.clone();
            thread::spawn(move || answer(stream.unwrap(), number < failing, &sender));
        }
    });
    (address, requests)
}

fn answer(mut stream: TcpStream, fails: bool, requests: &Sender<Request>) {
    let mut reader = BufReader::new(stream.try_clone().unwrap());
    let (mut head, mut length) = (String::new(), 0);
    loop {
        let mut line = String::new();
        if reader.read_line(&mut line).unwrap_or(0) == 0 || line == "\r\n" {
            break;
        }
        if let Some(value) = line.to_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().unwrap();
        }
        head.push_str(&line);
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).unwrap();
    let status = if fails { "503 Service Unavailable" } else { "200 OK" };
    write!(stream, "HTTP/1.1 {status}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n").unwrap();
    // the test may have ended
    let _ = requests.send(Request { head, body: serde_json::from_slice(&body).unwrap() });
}

/// Takes mails, and sends what stands in them.
fn smtp() -> (SocketAddr, Receiver<String>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let (sender, mails) = channel();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
            write!(stream, "220 test\r\n").unwrap();
            let mut mail = String::new();
            while let Some(Ok(line)) = lines.next() {
                match line.split(' ').next().unwrap().to_uppercase().as_str() {
                    "DATA" => {
                        write!(stream, "354 go on\r\n").unwrap();
                        let text = lines.by_ref().map(Result::unwrap).take_while(|line| line != ".");
                        mail += &text.collect::<Vec<_>>().join("\n");
                        write!(stream, "250 taken\r\n").unwrap();
                    }
                    "QUIT" => break,
                    _ => {
                        mail += &format!("{line}\n");
                        write!(stream, "250 test\r\n").unwrap();
                    }
                }
            }
            let _ = sender.send(mail);
        }
    });
    (address, mails)
}

#[tokio::test(flavor = "multi_thread")]
async fn an_alert_reaches_webhook_alertmanager_and_people_once() {
    let site = Site::with(&two_storeys(DAMAGED));
    let (hook, hooks) = http(2);
    let (manager, managed) = http(0);
    let (server, mails) = smtp();
    std::fs::write(site.folder().join("token"), format!("{TOKEN}\n")).unwrap();
    let configuration = site.folder().join("spandrel.toml");
    let text = format!(
        "[[notify.webhook]]\nurl = \"http://{hook}{PATH}\"\ntoken-file = \"token\"\n\
         [[notify.webhook]]\nurl = \"http://{manager}/api/v2/alerts\"\nformat = \"alertmanager\"\n\
         [[notify.email]]\nserver = \"127.0.0.1\"\nport = {}\nencryption = \"none\"\n\
         from = \"Bridges <bridges@site.example>\"\nto = [\"ada@site.example\", \"bo@site.example\"]\n",
        server.port()
    );
    std::fs::write(&configuration, text).unwrap();
    let services = Process::start(site.listening("run").arg("--config").arg(&configuration).args(["--http", "none"]));
    services.wait_for_log("ready structures=1");
    let bus = site.join().await;
    site.wait_for_services(&bus).await;
    let record = site.simulate(60.0);
    site.replay(&record, "max").wait().expect_code(0);

    // two attempts fail, the third is taken: the same alert under the same key
    let attempts: Vec<Request> = (0..3).map(|_| hooks.recv_timeout(DEADLINE).unwrap()).collect();
    for attempt in &attempts {
        assert!(attempt.head.starts_with(&format!("POST {PATH} ")), "{}", attempt.head);
        assert!(attempt.head.to_lowercase().contains(&format!("authorization: bearer {TOKEN}")), "{}", attempt.head);
        assert_eq!((&attempt.body["parameter"], &attempt.body["state"]), (&"storey-2".into(), &"raised".into()));
        assert_eq!(attempt.body["key"], attempts[0].body["key"]);
        assert!(attempt.body["why"].as_str().unwrap().contains("storey-2 has lost"), "{}", attempt.body);
    }
    let alert = managed.recv_timeout(DEADLINE).unwrap();
    assert!(alert.head.starts_with("POST /api/v2/alerts "), "{}", alert.head);
    assert_eq!(alert.body[0]["labels"]["parameter"], "storey-2");
    assert!(alert.body[0].get("endsAt").is_none(), "{}", alert.body);
    let mail = mails.recv_timeout(DEADLINE).unwrap();
    for part in ["RCPT TO:<ada@site.example>", "RCPT TO:<bo@site.example>", "Subject: house: alert of storey-2 raised"]
    {
        assert!(mail.contains(part), "{part}\n{mail}");
    }
    assert!(mail.contains("storey-2 has lost") && mail.contains("Rule:"), "{mail}");

    // whoever asks the alert service again hears the same, and it is not told again
    assert!(hooks.recv_timeout(Duration::from_secs(2)).is_err(), "told once");
    assert!(mails.try_recv().is_err(), "told once");
    bus.close().await.unwrap();
    let finished = services.stop().expect_code(0);
    for secret in [TOKEN, "s3cret-path"] {
        assert!(!finished.stderr.contains(secret), "{secret} in the log:\n{}", finished.stderr);
    }
    assert!(finished.stderr.contains("alert not told, it is tried again"), "{}", finished.stderr);
}

#[test]
fn settings_that_cannot_be_used_are_named() {
    let site = Site::with(&two_storeys(DAMAGED));
    let configuration = site.folder().join("spandrel.toml");
    for (text, parts) in [
        ("[[notify.webhook]]\nurl = \"gopher://x/s3cret\"\n", &["notify.webhook[0].url", "https://"][..]),
        ("[[notify.webhook]]\nurl = \"http://x/\"\ntoken-file = \"nowhere\"\n", &["nowhere", "webhook[0].token-file"]),
        (
            "[[notify.email]]\nserver = \"mail\"\nfrom = \"a@b.example\"\nto = [\"somebody\"]\n",
            &["notify.email[0].to", "\"somebody\""],
        ),
        ("[[notify.pager]]\nnumber = 1\n", &["pager", "webhook"]),
        ("", &["nobody to tell"]),
    ] {
        std::fs::write(&configuration, text).unwrap();
        let mut command = spandrel("notify");
        command.arg(site.structure_file()).arg("--config").arg(&configuration);
        let finished = Process::start(&mut command).wait().expect_code(2).expect_told(parts);
        assert!(!finished.stderr.contains("s3cret"), "{}", finished.stderr);
    }
}
