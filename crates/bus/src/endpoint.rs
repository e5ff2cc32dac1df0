//! Who can reach an endpoint: this machine, or more than that.

use std::net::IpAddr;

/// Protocols of Zenoh whose other end is on this machine.
const LOCAL_PROTOCOLS: [&str; 2] = ["unixsock-stream", "unixpipe"];
/// The protocol of Zenoh that shows and asks for certificates: TLS 1.3 over UDP.
const QUIC: &str = "quic";
/// Metadata that makes a link carry everything in the order in which it was sent. With a stream for each priority, data
/// that overtake the declaration of their key would be dropped.
const ONE_STREAM: &str = "multistream=0";
/// Setting of a single endpoint that takes the place of that of the session.
const MUTUAL_TLS: &str = "enable_mtls=";

/// A Zenoh endpoint taken apart: `PROTOCOL/ADDRESS?METADATA#SETTINGS`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Endpoint<'e> {
    protocol: &'e str,
    address: &'e str,
    metadata: &'e str,
    settings: &'e str,
}

impl<'e> Endpoint<'e> {
    pub(crate) fn new(text: &'e str) -> Self {
        let (locator, settings) = text.split_once('#').unwrap_or((text, ""));
        let (locator, metadata) = locator.split_once('?').unwrap_or((locator, ""));
        let (protocol, address) = locator.split_once('/').unwrap_or(("", locator));
        Self {
            protocol,
            address,
            metadata,
            settings,
        }
    }

    /// `host:port` where there is one.
    pub(crate) fn address(&self) -> &'e str {
        self.address
    }

    /// The host, without the brackets of an IPv6 address.
    pub(crate) fn host(&self) -> &'e str {
        let host = self
            .address
            .rsplit_once(':')
            .map_or(self.address, |(host, _port)| host);
        host.strip_prefix('[')
            .and_then(|host| host.strip_suffix(']'))
            .unwrap_or(host)
    }

    /// Whether it is reached over TCP, with nothing in between.
    pub(crate) fn is_tcp(&self) -> bool {
        self.protocol == "tcp"
    }

    /// Whether both sides can be made to show certificates.
    pub(crate) fn is_quic(&self) -> bool {
        self.protocol == QUIC
    }

    /// Whether it is TLS over TCP, which Zenoh breaks: its link reads and writes one connection of rustls from two threads at
    /// once, without a lock (eclipse-zenoh/zenoh issue 2557).
    pub(crate) fn is_tls_over_tcp(&self) -> bool {
        self.protocol == "tls"
    }

    /// Whether the endpoint itself says that who connects need not show a certificate.
    pub(crate) fn waives_certificates(&self) -> bool {
        let says = |setting: &str| {
            setting
                .trim()
                .strip_prefix(MUTUAL_TLS)
                .is_some_and(|value| value.trim() != "true")
        };
        self.settings.split(';').any(says)
    }

    /// Whether only this machine reaches it. A name other than `localhost` may stand for any address.
    pub(crate) fn is_of_this_machine(&self) -> bool {
        LOCAL_PROTOCOLS.contains(&self.protocol) || is_loopback(self.host())
    }
}

/// A QUIC endpoint whose link keeps the order of all that is sent, unless its metadata say otherwise; others as they are.
#[must_use]
pub fn in_order(endpoint: &str) -> String {
    let parts = Endpoint::new(endpoint);
    if !parts.is_quic() || parts.metadata.contains("multistream=") {
        return endpoint.to_owned();
    }
    let (locator, settings) = endpoint
        .split_once('#')
        .map_or((endpoint, None), |(locator, rest)| (locator, Some(rest)));
    let joint = if locator.contains('?') { ';' } else { '?' };
    let settings = settings
        .map(|settings| format!("#{settings}"))
        .unwrap_or_default();
    format!("{locator}{joint}{ONE_STREAM}{settings}")
}

/// Whether only this machine reaches a host: `localhost`, or an address of the loopback interface.
#[must_use]
pub fn is_loopback(host: &str) -> bool {
    host == "localhost"
        || host
            .parse::<IpAddr>()
            .is_ok_and(|address| address.to_canonical().is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopback_addresses_and_local_sockets_are_of_this_machine() {
        for text in [
            "tcp/127.0.0.1:7447",
            "tcp/127.1.2.3:0",
            "tcp/[::1]:7447",
            "tcp/[::ffff:127.0.0.1]:7447",
            "quic/localhost:7447",
            "tcp/127.0.0.1:7447#iface=lo",
            "udp/127.0.0.1:1?rel=1",
            "unixsock-stream//run/spandrel.sock",
        ] {
            assert!(Endpoint::new(text).is_of_this_machine(), "{text}");
        }
    }

    #[test]
    fn everything_else_reaches_further() {
        for text in [
            "tcp/0.0.0.0:7447",
            "tcp/[::]:7447",
            "tcp/10.0.0.5:7447",
            "tcp/site.example:7447",
            "tcp/localhost.example:7447",
            "tcp/127.0.0.1.example:7447",
            "udp/224.0.0.224:7446",
            "tcp/10.0.0.5:7447#127.0.0.1:7447",
            "vsock/2:1234",
            "serial//dev/ttyUSB0",
            "7447",
            "",
        ] {
            assert!(!Endpoint::new(text).is_of_this_machine(), "{text}");
        }
    }

    #[test]
    fn quic_keeps_the_order_unless_told_otherwise() {
        for (given, expected) in [
            ("quic/10.0.0.5:7447", "quic/10.0.0.5:7447?multistream=0"),
            (
                "quic/10.0.0.5:7447#iface=eth0",
                "quic/10.0.0.5:7447?multistream=0#iface=eth0",
            ),
            (
                "quic/10.0.0.5:7447?rel=1#iface=eth0",
                "quic/10.0.0.5:7447?rel=1;multistream=0#iface=eth0",
            ),
            (
                "quic/10.0.0.5:7447?multistream=1",
                "quic/10.0.0.5:7447?multistream=1",
            ),
            ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7447"),
        ] {
            assert_eq!(in_order(given), expected);
        }
    }

    #[test]
    fn an_endpoint_can_waive_certificates() {
        assert!(
            Endpoint::new("quic/0.0.0.0:7447#iface=eth0;enable_mtls=false").waives_certificates()
        );
        assert!(!Endpoint::new("quic/0.0.0.0:7447#enable_mtls=true").waives_certificates());
        assert!(!Endpoint::new("quic/0.0.0.0:7447").waives_certificates());
    }
}
