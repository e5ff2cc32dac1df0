use super::*;
use crate::source_plan::Stamps;

const HOUSE: &str = r#"
[structure]
name = "house"
sampling-rate-hz = 100
[model]
kind = "shear-building"
storeys = 1
mass-kg = 20_000
first-frequency-hz = 2.0
[damping]
kind = "rayleigh"
ratio = 0.02
[[parameter]]
name = "storey-1"
scales = "stiffness"
of = ["storey-1"]
[[excitation]]
name = "ground"
kind = "ground"
std = 0.1
measured-on = "ground"
[[node]]
name = "ground"
[[node.channel]]
name = "ground"
quantity = "ground-acceleration"
unit = "m/s2"
noise-std = 0.005
[[node]]
name = "roof"
[[node.channel]]
name = "roof"
quantity = "absolute-acceleration"
dof = "floor-1"
unit = "m/s2"
noise-std = 0.005
"#;

fn check(text: &str) -> Result<FeedConfig, FeedError> {
    let structure = Structure::parse(HOUSE, Path::new("house.toml")).unwrap();
    let mut settings: FeedSettings = toml::from_str(text).unwrap();
    settings.resolve(Path::new("spandrel.toml"));
    settings.check(&[&structure])
}

#[test]
fn source_gives_each_channel_its_node() {
    let config = check(
        r#"
[[source]]
name = "shake"
kind = "udp"
address = "0.0.0.0:8888"
format = "raspberry-shake"
[[source.channel]]
source = "ENZ"
channel = "roof"
sensitivity = 384500
sign = -1
"#,
    )
    .unwrap();
    let channel = &config.sources[0].channels[0];
    assert_eq!(config.nodes[channel.node].name, "roof");
    assert_eq!(channel.calibration.si_from_number(-384_500.0, 0), Some(1.0));
    assert_eq!(config.sources[0].stamps, Stamps::Source { jitter_s: 0.0 });
}

#[test]
fn all_mistakes_are_reported_at_once_with_file_and_key() {
    let wrong = check(
        r#"
[[source]]
name = "a"
kind = "udp"
address = "8888"
format = "raspberry-shake"
colour = "red"
[[source.channel]]
source = "ENZ"
channel = "attic"
sensitivity = 0
[[source]]
name = "a"
kind = "stdin"
format = "csv"
columns = ["ax"]
[[source.channel]]
source = "ay"
structure = "tower"
channel = "roof"
[[source]]
kind = "pigeon"
"#,
    );
    let text = wrong.unwrap_err().to_string();
    let expected = [
        "spandrel.toml: feed.source[0].address: is \"8888\", must be HOST:PORT",
        "spandrel.toml: feed.source[0].colour: is an unknown key here, must be one of address,",
        "spandrel.toml: feed.source[0].channel[0].channel: is \"attic\", must be one of ground, roof",
        "spandrel.toml: feed.source[0].channel[0].sensitivity: is 0, must be a finite number except 0",
        "spandrel.toml: feed.source[1].name: is \"a\" again, must differ",
        "spandrel.toml: feed.source[1].channel: has source \"ay\", must be one of the columns ax",
        "spandrel.toml: feed.source[1].jitter-s: is missing, must state how far arrival times",
        "spandrel.toml: feed.source[1].channel[0].structure: is \"tower\", must be one of house",
        "spandrel.toml: feed.source[1].channel[0].sensitivity: is missing, must be the counts",
        "spandrel.toml: feed.source[2].name: is missing",
        "spandrel.toml: feed.source[2].kind: is \"pigeon\", must be one of \"udp\"",
        "spandrel.toml: feed.source[2].channel: is missing, must have at least one channel",
    ];
    for line in expected {
        assert!(text.contains(line), "expected {line}\nfound\n{text}");
    }
    assert_eq!(text.lines().count(), expected.len(), "{text}");
}

#[test]
fn channel_of_the_structure_has_one_source() {
    let wrong = check(
        r#"
[[source]]
name = "a"
kind = "udp"
address = "0.0.0.0:8888"
format = "raspberry-shake"
[[source.channel]]
source = "ENZ"
channel = "roof"
sensitivity = 1
[[source.channel]]
source = "ENE"
channel = "roof"
sensitivity = 1
"#,
    );
    let expected = "feed.source[0].channel[1].channel: is \"roof\" again, must be a channel that \
                    feed.source[0].channel[0].channel does not feed";
    assert!(wrong.unwrap_err().to_string().contains(expected));
}
