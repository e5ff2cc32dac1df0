use super::*;
use nalgebra::DMatrix;
use spandrel_filter::{ObservationModel, ProcessModel};
use std::path::Path;

fn example(name: &str) -> Structure {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../docs/examples")
        .join(name);
    Structure::read(&path).unwrap_or_else(|error| panic!("{error}"))
}

/// Asserts that a class with calibrated components equals the full model at the products of factors
/// and multipliers.
#[track_caller]
fn assert_class_is_full_model(name: &str, grouping: &[&[usize]]) {
    let structure = example(name);
    let system = structure.class_system();
    let components = system.components().len();
    let grouping = Grouping::new(
        grouping.iter().map(|group| group.to_vec()).collect(),
        components,
    )
    .unwrap();
    let factors: Vec<f64> = (0..components).map(|n| 1.0 - 0.01 * n as f64).collect();
    let (mut full, mut class) = (structure.model(), system.grouped(&grouping, &factors));
    let parameters = structure.parameters().len();
    let motion = full.state_len() - parameters;
    let groups = grouping.groups().len();
    let others = parameters - components;
    assert_eq!(class.state_len(), motion + groups + others);
    let moved: Vec<f64> = (0..motion)
        .map(|j| 1e-3 * ((j * 7 + 3) % 11) as f64 - 5e-3)
        .collect();
    let multipliers: Vec<f64> = (0..groups).map(|group| 0.9 + 0.05 * group as f64).collect();
    let rest: Vec<f64> = (0..others).map(|other| 1.1 - 0.02 * other as f64).collect();
    let of_class = [&moved[..], &multipliers, &rest].concat();
    let mut of_full = moved.clone();
    let (mut component, mut other) = (0, 0);
    for parameter in structure.parameters() {
        if parameter.is_stiffness() {
            of_full.push(factors[component] * multipliers[grouping.group_of(component)]);
            component += 1;
        } else {
            of_full.push(rest[other]);
            other += 1;
        }
    }
    let excitation = vec![0.3; full.excitation_len()];
    full.linearise_process(&of_full, &excitation);
    class.linearise_process(&of_class, &excitation);
    full.linearise_observation(&of_full, &excitation);
    class.linearise_observation(&of_class, &excitation);
    let derivative = |model: &StructureModel| {
        let mut out = vec![0.0; model.state_len()];
        model.derivative(&mut out);
        out.truncate(motion);
        out
    };
    let observed = |model: &StructureModel| {
        let mut out = vec![0.0; model.observation_len()];
        model.observe(&mut out);
        out
    };
    for (one, another) in [
        (derivative(&full), derivative(&class)),
        (observed(&full), observed(&class)),
    ] {
        let scale = one
            .iter()
            .fold(0.0_f64, |most, value| most.max(value.abs()));
        for (one, another) in one.iter().zip(&another) {
            assert!(
                (one - another).abs() <= 1e-11 * scale,
                "{name}: {one} {another}"
            );
        }
    }
    // ∂/∂(multiplier of a group) = Σ factor ∂/∂(component)
    let mut direction = DMatrix::zeros(full.state_len(), 1);
    let (mut at, mut component) = (motion, 0);
    for parameter in structure.parameters() {
        if parameter.is_stiffness() {
            if grouping.group_of(component) == 0 {
                direction[(at, 0)] = factors[component];
            }
            component += 1;
        }
        at += 1;
    }
    let mut unit = DMatrix::zeros(class.state_len(), 1);
    unit[(motion, 0)] = 1.0;
    let (mut one, mut another) = (direction.clone(), unit.clone());
    full.jacobian_mul(&direction, &mut one);
    class.jacobian_mul(&unit, &mut another);
    let scale = one.amax();
    assert!(scale > 0.0);
    for j in 0..motion {
        assert!(
            (one[(j, 0)] - another[(j, 0)]).abs() <= 1e-11 * scale,
            "{name}: {j}"
        );
    }
}

#[test]
fn classes_are_the_full_model_with_multipliers_in_common() {
    assert_class_is_full_model("high-rise.toml", &[&[0], &[1, 2, 3, 4]]);
    assert_class_is_full_model("bouc-wen-five.toml", &[&[2]]);
    assert_class_is_full_model("dome-bars.toml", &[&[30], &[3, 9, 15]]);
    assert_class_is_full_model("demo.toml", &[&[1]]);
}

#[test]
fn examples_have_the_published_classes() {
    let high_rise = example("high-rise.toml").class_bank().unwrap().unwrap();
    assert_eq!(
        (0..5)
            .map(|class| high_rise.grouping(class).groups().len())
            .collect::<Vec<_>>(),
        [1, 4, 5, 6, 7]
    );
    assert_eq!(high_rise.settings().persistence_steps, 200);
    let chain = example("bouc-wen-five.toml");
    let bank = chain.class_bank().unwrap().unwrap();
    let names: Vec<&str> = bank
        .classes()
        .map(|class| chain.class_name(class))
        .collect();
    assert_eq!(
        names,
        [
            "baseline", "storey-1", "storey-2", "storey-3", "storey-4", "storey-5"
        ]
    );
    assert_eq!(bank.settings().persistence_steps, 500);
    let dome = example("dome-bars.toml");
    let bank = dome.class_bank().unwrap().unwrap();
    assert_eq!(bank.classes().len(), 7);
    let bar_31 = ClassId::Component {
        component: 30,
        substructure: 0,
    };
    assert_eq!(
        (dome.class_name(bar_31), dome.singled_out(bar_31)),
        ("bar-31", Some(30))
    );
    assert!(example("demo.toml").class_bank().unwrap().is_none());
}
