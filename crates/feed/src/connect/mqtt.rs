//! Subscribes to a topic of an MQTT 3.1.1 broker.
//!
//! The session is persistent: while the feed is disconnected, the broker keeps the messages that
//! were published with quality of service 1 or 2, within the limits of its configuration.

use std::time::Duration;

use rumqttc::{AsyncClient, Event, EventLoop, Incoming, MqttOptions, QoS, SubscribeReasonCode};

use crate::connect::Outlet;
use crate::connect::lines::parse_all;
use crate::connect::retry::Retry;
use crate::core_input::Link;
use crate::lines::{LineSplitter, quoted};
use crate::packet::Packet;
use crate::source_plan::{MqttSession, MqttTopic, Payload};

/// Keep-alive interval. After one and a half intervals without a packet, the broker closes the
/// connection.
const KEEP_ALIVE: Duration = Duration::from_secs(20);
/// Maximum size of a message in bytes.
const MAX_MESSAGE_BYTES: usize = 1 << 20;
/// Maximum number of requests that wait to be sent. Only subscriptions are sent.
const REQUESTS: usize = 4;

/// Reads messages until the feed stops.
pub(crate) async fn read(plan: MqttTopic, outlet: Outlet) {
    let mut options = MqttOptions::new(&plan.client_id, &plan.host, plan.port);
    options.set_keep_alive(KEEP_ALIVE);
    options.set_clean_session(plan.session == MqttSession::Clean);
    options.set_max_packet_size(MAX_MESSAGE_BYTES, MAX_MESSAGE_BYTES);
    if let Some(login) = &plan.login {
        options.set_credentials(&login.user, &login.password);
    }
    let (client, mut broker) = AsyncClient::new(options, REQUESTS);
    let mut retry = Retry::new();
    outlet.link(Link::Connecting).await;
    while !outlet.is_closed() {
        let why = match serve(&client, &mut broker, &plan, &outlet, &mut retry).await {
            Ok(()) => return,
            Err(why) => format!("{}:{}: {why}", plan.host, plan.port),
        };
        outlet.failed(why).await;
        retry.pause().await;
    }
}

/// Reads one connection. Returns without an error if the feed stops.
async fn serve(
    client: &AsyncClient,
    broker: &mut EventLoop,
    plan: &MqttTopic,
    outlet: &Outlet,
    retry: &mut Retry,
) -> Result<(), String> {
    loop {
        let event = broker.poll().await.map_err(|error| error.to_string())?;
        let Event::Incoming(incoming) = event else {
            continue;
        };
        match incoming {
            Incoming::ConnAck(_) => {
                let asked = client.subscribe(&plan.topic, QoS::AtLeastOnce).await;
                asked.map_err(|error| error.to_string())?;
            }
            Incoming::SubAck(answer) => {
                if answer.return_codes.contains(&SubscribeReasonCode::Failure) {
                    return Err(format!("the broker rejects the topic {}", plan.topic));
                }
                retry.reset();
                outlet.link(Link::Open).await;
            }
            Incoming::Publish(message) => {
                let (packets, faults) = packets_of(&plan.payload, &message.payload);
                for fault in faults {
                    let fault = format!("{}: {fault}", quoted(&message.topic));
                    if !outlet.malformed(fault).await {
                        return Ok(());
                    }
                }
                if !outlet.packets(packets).await {
                    return Ok(());
                }
            }
            _ => {}
        }
    }
}

/// Returns the packets of a message and its faults.
fn packets_of(payload: &Payload, bytes: &[u8]) -> (Vec<Packet>, Vec<String>) {
    match payload {
        Payload::Lines(format) => {
            let (mut splitter, mut lines) = (LineSplitter::default(), Vec::new());
            splitter.push(bytes, &mut lines);
            lines.extend(splitter.end());
            parse_all(format, lines)
        }
        Payload::Raw(raw) => match raw.parse(bytes) {
            Ok(packets) => (packets, Vec::new()),
            Err(fault) => (Vec::new(), vec![fault.to_string()]),
        },
    }
}
