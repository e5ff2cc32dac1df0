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
fn structures_that_share_a_source_form_a_part() {
    let names = ["a", "b", "c", "d"];
    let houses = names.map(|name| {
        let text = HOUSE.replace("name = \"house\"", &format!("name = \"{name}\""));
        let text = text + "[[condition]]\nname = \"air\"\nunit = \"degC\"\n";
        Structure::parse(&text, Path::new("house.toml")).unwrap()
    });
    let channel = |structure: &str, channel: &str| {
        format!(
            "[[source.channel]]\nsource = \"{structure}-{channel}\"\nstructure = \"{structure}\"\n\
             channel = \"{channel}\"\nsensitivity = 1\n"
        )
    };
    let air = "[[source.condition]]\nsource = \"air\"\nstructure = \"a\"\ncondition = \"air\"\n";
    let channels = [
        channel("a", "roof"),
        channel("b", "roof") + &channel("c", "roof"),
        channel("b", "ground"),
        channel("c", "ground") + air,
    ];
    let source = |(number, channels): (usize, &String)| {
        format!(
            "[[source]]\nname = \"{number}\"\nkind = \"tcp\"\naddress = \"127.0.0.1:{number}\"\n\
             format = \"json\"\njitter-s = 0.01\n{channels}"
        )
    };
    let parts = |last: usize| {
        let used = channels.get(..=last).unwrap();
        let text: String = (1..).zip(used).map(source).collect();
        let settings: FeedSettings = toml::from_str(&text).unwrap();
        let parts = settings.check(&houses.each_ref()).unwrap().parts();
        let brief = |part: FeedConfig| {
            let sources = part.sources.iter().map(|source| source.name.clone());
            let channels = part.sources.iter().flat_map(|source| &source.channels);
            let nodes = channels.map(|channel| {
                let node = part.nodes.get(channel.node).unwrap();
                format!("{}-{}", names[node.structure], node.name)
            });
            (sources.collect::<String>(), nodes.collect::<Vec<_>>())
        };
        parts.into_iter().map(brief).collect::<Vec<_>>()
    };
    let nodes = |nodes: &[&str]| {
        nodes
            .iter()
            .map(|&node| node.to_owned())
            .collect::<Vec<_>>()
    };
    let a = ("1".to_owned(), nodes(&["a-roof"]));
    let others = ("23".to_owned(), nodes(&["b-roof", "c-roof", "b-ground"]));
    assert_eq!(parts(2), [a, others]);
    // A condition of `a` connects all of them. Nothing feeds `d`.
    let all = nodes(&["a-roof", "b-roof", "c-roof", "b-ground", "c-ground"]);
    assert_eq!(parts(3), [("1234".to_owned(), all)]);
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
        "spandrel.toml: feed.source[0].channel[0].channel: is \"attic\", must be one of ground, \
         roof",
        "spandrel.toml: feed.source[0].channel[0].sensitivity: is 0, must be a finite number \
         except 0",
        "spandrel.toml: feed.source[1].name: is \"a\" again, must differ",
        "spandrel.toml: feed.source[1].channel: has source \"ay\", must be one of the columns ax",
        "spandrel.toml: feed.source[1].jitter-s: is missing, must state how far arrival times",
        "spandrel.toml: feed.source[1].channel[0].structure: is \"tower\", must be one of house",
        "spandrel.toml: feed.source[1].channel[0].sensitivity: is missing, must be the counts",
        "spandrel.toml: feed.source[2].name: is missing",
        "spandrel.toml: feed.source[2].kind: is \"pigeon\", must be one of \"udp\"",
        "spandrel.toml: feed.source[2].channel: is missing, must have at least one channel, [[feed",
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

#[test]
fn units_of_structure_files_are_those_of_the_messages() {
    let of_messages: Vec<&str> = spandrel_bus::ConditionDisplay::units().collect();
    assert_eq!(of_messages, spandrel_structure::Condition::UNITS);
}

const AIR: &str =
    "[[condition]]\nname = \"air\"\nunit = \"degC\"\nrange = [-40, 60]\ninterval-s = 600\n";

fn check_with_air(text: &str) -> Result<FeedConfig, FeedError> {
    let house = format!("{HOUSE}\n{AIR}");
    let structure = Structure::parse(&house, Path::new("house.toml")).unwrap();
    let mut settings: FeedSettings = toml::from_str(text).unwrap();
    settings.resolve(Path::new("spandrel.toml"));
    settings.check(&[&structure])
}

#[test]
fn condition_has_the_unit_range_and_interval_of_the_structure_file() {
    let config = check_with_air(
        r#"
[[source]]
name = "mast"
kind = "stdin"
format = "csv"
columns = ["t"]
[[source.condition]]
source = "t"
condition = "air"
sensitivity = 10
offset = 400
"#,
    )
    .unwrap();
    let mast = &config.sources[0];
    // No channel needs a rate, so the source needs no jitter.
    assert_eq!(mast.stamps, Stamps::Arrival { jitter_s: 0.0 });
    let air = &mast.conditions[0];
    assert_eq!((air.unit, air.range), ("degC", Some((-40.0, 60.0))));
    assert_eq!(air.calibration.si_from_number(615.0, 0), Some(21.5));
    assert_eq!(mast.silent_after_s(), Some(1200.0));
    assert!(config.feeds(0) && config.nodes.is_empty());
}

#[test]
fn condition_has_one_source_and_must_be_declared() {
    let wrong = check_with_air(
        r#"
[[source]]
name = "mast"
kind = "udp"
address = "0.0.0.0:8888"
format = "json"
[[source.condition]]
source = "t"
condition = "air"
[[source.condition]]
source = "u"
condition = "air"
[[source.condition]]
source = "v"
condition = "wind"
"#,
    );
    let text = wrong.unwrap_err().to_string();
    for expected in [
        "feed.source[0].condition[1].condition: is \"air\" again, must be a condition that \
         feed.source[0].condition[0].condition does not feed",
        "feed.source[0].condition[2].condition: is \"wind\", must be one of air (house)",
    ] {
        assert!(
            text.contains(expected),
            "expected {expected}\nfound\n{text}"
        );
    }
}
