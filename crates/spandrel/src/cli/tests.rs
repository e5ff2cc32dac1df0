use super::values::Band;
use super::*;
use clap::CommandFactory;

#[test]
fn command_line_is_consistent() {
    Arguments::command().debug_assert();
}

#[test]
fn every_subcommand_shows_an_example() {
    for command in Arguments::command().get_subcommands() {
        let help = command
            .get_after_help()
            .map(ToString::to_string)
            .unwrap_or_default();
        assert!(
            help.contains("Example"),
            "{} has no example",
            command.get_name()
        );
    }
}

#[test]
fn error_names_the_range_of_a_number() {
    for (option, told) in [
        ("--drift=-1", "must be a number, 0 or more"),
        ("--warm-up", "0 or more"),
    ] {
        let mut words = vec![
            "spandrel", "estimate", "a.toml", "--record", "a.csv", option,
        ];
        if !option.contains('=') {
            words.push("-3");
        }
        let error = Arguments::try_parse_from(words).unwrap_err().to_string();
        assert!(error.contains(told), "{error}");
    }
    let words = [
        "spandrel", "simulate", "a.toml", "--record", "a.csv", "--speed", "2",
    ];
    let error = Arguments::try_parse_from(words).unwrap_err().to_string();
    assert!(error.contains("cannot be used with"), "{error}");
}

#[test]
fn defaults_of_particles_equal_those_in_the_help() {
    let Command::Estimate(arguments) =
        Arguments::try_parse_from(["spandrel", "estimate", "a.toml", "--record", "a.csv"])
            .unwrap()
            .command
    else {
        panic!("another command")
    };
    let plan = arguments.particle.plan();
    assert_eq!(
        (
            plan.settings.particles,
            plan.settings.seed,
            plan.settings.kernel
        ),
        (2000, 0, 1.0)
    );
    assert_eq!((plan.drift_per_root_s, plan.warm_up_s), (0.005, 2.0));
    assert_eq!(arguments.particle.given(), None);
}

#[test]
fn seeds_are_single_ones_or_a_range_but_not_both() {
    let parse = |options: &[&str]| {
        let words = ["spandrel", "validate"].iter().chain(options);
        Arguments::try_parse_from(words).map(|arguments| match arguments.command {
            Command::Validate(arguments) => (arguments.seed, arguments.seeds),
            _ => panic!("another command"),
        })
    };
    assert_eq!(
        parse(&["--seed", "17", "--seed", "5"]).unwrap(),
        (vec![17, 5], None)
    );
    let (single, range) = parse(&["--seeds", "4..8"]).unwrap();
    assert_eq!(
        (single, range.unwrap().iter().collect::<Vec<_>>()),
        (Vec::new(), vec![4, 5, 6, 7, 8])
    );
    for (options, told) in [
        (&["--seeds", "8..4"][..], "the range 8..4 is empty"),
        (&["--seed", "17", "--seeds", "4..8"], "cannot be used with"),
        (&["--seed", "many"], "invalid digit"),
    ] {
        let error = parse(options).unwrap_err().to_string();
        assert!(error.contains(told), "{error}");
    }
}

#[test]
fn band_is_two_increasing_frequencies() {
    let band = Band {
        lowest_hz: 0.5,
        highest_hz: 12.0,
    };
    assert_eq!("0.5..12".parse(), Ok(band));
    for wrong in ["5", "5..", "12..0.5", "-1..3", "0..inf", "a..b"] {
        assert!(wrong.parse::<Band>().is_err(), "{wrong}");
    }
}

#[test]
fn speed_is_a_number_or_max() {
    assert_eq!("max".parse(), Ok(Speed::Max));
    assert_eq!("10".parse(), Ok(Speed::Times(10.0)));
    for wrong in ["0", "-1", "fast", "inf", ""] {
        assert!(wrong.parse::<Speed>().is_err(), "{wrong}");
    }
}
