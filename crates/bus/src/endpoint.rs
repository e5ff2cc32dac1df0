//! Parsing of endpoints, and their reachability from other machines.

use std::net::IpAddr;

/// Protocols of Zenoh that connect programs on one machine only.
const LOCAL_PROTOCOLS: [&str; 2] = ["unixsock-stream", "unixpipe"];
/// Protocol of Zenoh with mutual certificates: TLS 1.3 over UDP.
const QUIC: &str = "quic";
/// Metadata for a link that transports all data in the order of sending.
///
/// With one stream per priority, data can overtake the declaration of their key and would be
/// dropped.
const ONE_STREAM: &str = "multistream=0";
/// Setting of an endpoint that overrides the setting of the session.
const MUTUAL_TLS: &str = "enable_mtls=";

/// A parsed Zenoh endpoint: `PROTOCOL/ADDRESS?METADATA#SETTINGS`.
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

    /// Returns the address, such as `host:port`.
    pub(crate) fn address(&self) -> &'e str {
        self.address
    }

    /// Returns the host, without the brackets of an IPv6 address.
    pub(crate) fn host(&self) -> &'e str {
        let host = self
            .address
            .rsplit_once(':')
            .map_or(self.address, |(host, _port)| host);
        host.strip_prefix('[')
            .and_then(|host| host.strip_suffix(']'))
            .unwrap_or(host)
    }

    /// Returns `true` if the endpoint uses unencrypted TCP.
    pub(crate) fn is_tcp(&self) -> bool {
        self.protocol == "tcp"
    }

    /// Returns `true` if the endpoint uses QUIC, which supports mutual certificates.
    pub(crate) fn is_quic(&self) -> bool {
        self.protocol == QUIC
    }

    /// Returns `true` if the endpoint uses TLS over TCP, which fails in Zenoh.
    ///
    /// Zenoh's link reads and writes one rustls connection from two threads at once, without a lock
    /// (eclipse-zenoh/zenoh issue 2557).
    pub(crate) fn is_tls_over_tcp(&self) -> bool {
        self.protocol == "tls"
    }

    /// Returns `true` if the endpoint itself accepts connections without a certificate.
    pub(crate) fn waives_certificates(&self) -> bool {
        let says = |setting: &str| {
            setting
                .trim()
                .strip_prefix(MUTUAL_TLS)
                .is_some_and(|value| value.trim() != "true")
        };
        self.settings.split(';').any(says)
    }

    /// Returns `true` if only this machine can reach the endpoint.
    ///
    /// Names other than `localhost` may resolve to any address and return `false`.
    pub(crate) fn is_of_this_machine(&self) -> bool {
        LOCAL_PROTOCOLS.contains(&self.protocol) || is_loopback(self.host())
    }
}

/// Adds the metadata for ordered transport to a QUIC endpoint.
///
/// Endpoints of other protocols or with a `multistream` setting remain unchanged.
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

/// Returns `true` if only this machine can reach a host: `localhost`, or an address of the loopback
/// interface.
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
    fn loopback_addresses_and_local_sockets_belong_to_this_machine() {
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
    fn all_other_endpoints_are_reachable_from_elsewhere() {
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
    fn quic_keeps_the_order_by_default() {
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
