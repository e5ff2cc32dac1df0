//! Rejects Zenoh configurations that accept connections from other machines without a certificate.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::endpoint::Endpoint;
use crate::error::BusError;
use crate::session::{Mode, set};
use crate::tls::{TlsConfig, read_pair};

/// Zenoh's default endpoint: a peer listens on all interfaces.
const LISTENS_EVERYWHERE: &str = "tcp/[::]:0";
/// Default endpoint of a peer in Spandrel.
const ANY_LOCAL_PORT: &str = "tcp/127.0.0.1:0";

/// Checks endpoints, certificates and scouting. Replaces Zenoh's default endpoint by a loopback
/// endpoint.
pub(crate) fn check(config: &mut zenoh::Config) -> Result<(), BusError> {
    let mut listen = listen_endpoints(config)?;
    if listen == [LISTENS_EVERYWHERE] {
        listen = vec![ANY_LOCAL_PORT.to_owned()];
        set(config, "listen/endpoints", &listen.clone().into())?;
    }
    let certificates = check_certificates(config)?;
    let connect = endpoints(config, "connect/endpoints")?;
    if let Some(endpoint) = listen
        .iter()
        .chain(&connect)
        .find(|endpoint| Endpoint::new(endpoint).is_tls_over_tcp())
    {
        return Err(BusError::TlsOverTcp {
            endpoint: endpoint.clone(),
        });
    }
    for endpoint in &listen {
        let parts = Endpoint::new(endpoint);
        if parts.is_of_this_machine() {
            continue;
        }
        if !parts.is_quic() {
            return Err(BusError::Unprotected {
                endpoint: endpoint.clone(),
            });
        }
        if !certificates.asked_for || parts.waives_certificates() {
            return Err(BusError::NoCertificateAsked {
                endpoint: endpoint.clone(),
            });
        }
    }
    if let Some(endpoint) = connect
        .iter()
        .find(|endpoint| Endpoint::new(endpoint).is_quic() && !certificates.own)
    {
        return Err(BusError::NoCertificates {
            endpoint: endpoint.clone(),
        });
    }
    let only_quic = get(config, "transport/link/protocols")? == serde_json::json!(["quic"]);
    if get(config, "scouting/multicast/enabled")? != Value::Bool(false) && !only_quic {
        return Err(BusError::Multicast);
    }
    Ok(())
}

/// Returns the mode in a configuration, if any.
pub(crate) fn mode(config: &zenoh::Config) -> Result<Option<Mode>, BusError> {
    Ok(serde_json::from_value(get(config, "mode")?).unwrap_or(None))
}

/// Returns the endpoints on which a session with this configuration listens.
pub(crate) fn listen_endpoints(config: &zenoh::Config) -> Result<Vec<String>, BusError> {
    endpoints(config, "listen/endpoints")
}

/// Returns the endpoints for the mode of the configuration.
///
/// The configuration contains one list, or one list per mode. Each endpoint is a text, or an object
/// with further settings.
fn endpoints(config: &zenoh::Config, key: &'static str) -> Result<Vec<String>, BusError> {
    let all = get(config, key)?;
    let of_mode = match &all {
        Value::Object(by_mode) => {
            let name = mode(config)?.unwrap_or_default().as_str();
            by_mode.get(name).cloned().unwrap_or(Value::Null)
        }
        _ => all,
    };
    let one = |value: &Value| match value {
        Value::String(text) => text.clone(),
        other => other
            .get("endpoint")
            .and_then(Value::as_str)
            .unwrap_or_default()
            .to_owned(),
    };
    Ok(of_mode
        .as_array()
        .map(|list| list.iter().map(one).collect())
        .unwrap_or_default())
}

fn get(config: &zenoh::Config, key: &'static str) -> Result<Value, BusError> {
    let text = config.get_json(key).map_err(|source| BusError::Setting {
        key,
        value: String::new(),
        source,
    })?;
    Ok(serde_json::from_str(&text).unwrap_or(Value::Null))
}

/// Certificate settings of a configuration.
struct Certificates {
    /// Whether clients must present a certificate.
    asked_for: bool,
    /// Whether this session can present a certificate.
    own: bool,
}

/// Checks the certificate files of a configuration.
fn check_certificates(config: &zenoh::Config) -> Result<Certificates, BusError> {
    let tls = get(config, "transport/link/tls")?;
    let file = |key: &str| tls.get(key).and_then(Value::as_str).map(PathBuf::from);
    let given = |key: &str| tls.get(key).is_some_and(|value| !value.is_null());
    let authority = file("root_ca_certificate");
    for (certificate, key) in [
        ("listen_certificate", "listen_private_key"),
        ("connect_certificate", "connect_private_key"),
    ] {
        match (
            file(certificate),
            file(key),
            authority.as_deref().map(Path::to_owned),
        ) {
            (Some(certificate), Some(key), authority @ Some(_)) => {
                TlsConfig {
                    certificate,
                    key: Some(key),
                    authority,
                }
                .check()?;
            }
            (Some(certificate), Some(key), None) => drop(read_pair(&certificate, &key)?),
            // The configuration contains the certificate as text, or there is none.
            _ => {}
        }
    }
    let either = |file: &str| given(file) || given(&format!("{file}_base64"));
    let asked_for =
        tls.get("enable_mtls") == Some(&Value::Bool(true)) && either("root_ca_certificate");
    Ok(Certificates {
        asked_for,
        own: either("connect_certificate") && either("connect_private_key"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checked(text: &str) -> Result<Vec<String>, BusError> {
        let mut config = zenoh::Config::from_json5(text).unwrap();
        check(&mut config)?;
        listen_endpoints(&config)
    }

    /// Returns a router configuration with this endpoint.
    fn router(endpoint: &str, tls: &str) -> String {
        format!(
            "{{mode: \"router\", listen: {{endpoints: [\"{endpoint}\"]}}, \
             scouting: {{multicast: {{enabled: false}}}}, transport: {{link: {{tls: {{{tls}}}}}}}}}"
        )
    }

    #[test]
    fn error_names_an_unprotected_endpoint_beyond_this_machine() {
        for endpoint in ["tcp/0.0.0.0:7447", "udp/10.0.0.5:1", "tcp/[::]:7447"] {
            let error = checked(&router(endpoint, "")).unwrap_err();
            assert!(
                matches!(&error, BusError::Unprotected { endpoint: found } if found == endpoint),
                "{error}"
            );
        }
        assert_eq!(
            checked(&router("tcp/127.0.0.1:7447", "")).unwrap(),
            ["tcp/127.0.0.1:7447"]
        );
    }

    #[test]
    fn endpoints_beyond_this_machine_require_client_certificates() {
        for (endpoint, tls) in [
            ("quic/0.0.0.0:7447", ""),
            ("quic/0.0.0.0:7447", "enable_mtls: true"),
            (
                "quic/0.0.0.0:7447",
                "enable_mtls: false, root_ca_certificate: \"a.pem\"",
            ),
            (
                "quic/0.0.0.0:7447#enable_mtls=false",
                "enable_mtls: true, root_ca_certificate: \"a.pem\"",
            ),
        ] {
            let error = checked(&router(endpoint, tls)).unwrap_err();
            assert!(
                matches!(error, BusError::NoCertificateAsked { .. }),
                "{endpoint} {tls}: {error}"
            );
        }
        let mutual = router(
            "quic/0.0.0.0:7447",
            "enable_mtls: true, root_ca_certificate: \"a.pem\"",
        );
        assert_eq!(checked(&mutual).unwrap(), ["quic/0.0.0.0:7447"]);
    }

    #[test]
    fn omitted_settings_open_no_unprotected_endpoint() {
        let quiet = "scouting: {multicast: {enabled: false}}";
        assert_eq!(checked(&format!("{{{quiet}}}")).unwrap(), [ANY_LOCAL_PORT]);
        let error = checked(&format!("{{mode: \"router\", {quiet}}}")).unwrap_err();
        assert!(matches!(error, BusError::Unprotected { .. }), "{error}");
        let error = checked("{mode: \"client\"}").unwrap_err();
        assert!(matches!(error, BusError::Multicast), "{error}");
    }

    #[test]
    fn endpoints_per_mode_are_checked_for_the_chosen_mode() {
        let by_mode = "{mode: \"router\", scouting: {multicast: {enabled: false}}, \
                       listen: {endpoints: {router: [\"tcp/10.0.0.5:1\"], peer: \
                       [\"tcp/127.0.0.1:0\"]}}}";
        assert!(matches!(
            checked(by_mode),
            Err(BusError::Unprotected { .. })
        ));
        assert!(checked(&by_mode.replace("mode: \"router\"", "mode: \"peer\"")).is_ok());
    }

    #[test]
    fn tls_over_tcp_is_rejected_with_a_hint() {
        let certificates = "enable_mtls: true, root_ca_certificate: \"a.pem\"";
        let error = checked(&router("tls/127.0.0.1:7447", certificates)).unwrap_err();
        assert!(
            error.to_string().contains("tls/127.0.0.1:7447") && error.to_string().contains("quic/"),
            "{error}"
        );
        let text = "{mode: \"client\", connect: {endpoints: [\"tls/site.example:7447\"]}, \
                    scouting: {multicast: {enabled: false}}}";
        assert!(matches!(checked(text), Err(BusError::TlsOverTcp { .. })));
    }

    #[test]
    fn a_connection_without_a_certificate_is_refused() {
        let text = "{mode: \"client\", connect: {endpoints: [\"quic/site.example:7447\"]}, \
                    scouting: {multicast: {enabled: false}}}";
        assert!(matches!(
            checked(text),
            Err(BusError::NoCertificates { .. })
        ));
    }
}
