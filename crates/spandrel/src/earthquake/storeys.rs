//! Displacements and drifts that the model can state, beside the responses of the structure file.

use spandrel_structure::Structure;
use std::fmt::Write as _;
use std::path::Path;

/// A structure that also estimates displacements, and how to call them.
#[derive(Debug)]
pub struct WithDisplacements {
    /// The structure, with the added responses if it accepts them.
    pub structure: Structure,
    /// Name for people of each response, in the order of the structure.
    pub labels: Vec<String>,
    /// Reason why no displacement is estimated. `None` if one is.
    pub missing: Option<&'static str>,
}

/// Adds the drift of each storey of a shear building, or the displacement at each acceleration of
/// another structure, unless the structure file has responses of its own.
///
/// A response changes no other estimate.
pub fn with_displacements(structure: Structure, path: &Path) -> WithDisplacements {
    let own: Vec<String> = structure
        .estimated_responses()
        .iter()
        .map(|response| response.name().to_owned())
        .collect();
    if !own.is_empty() {
        return WithDisplacements {
            structure,
            labels: own,
            missing: None,
        };
    }
    let without = |structure, missing| WithDisplacements {
        structure,
        labels: Vec::new(),
        missing: Some(missing),
    };
    if structure.fusion().is_some() {
        return without(
            structure,
            "nodes with their own filters estimate no displacement",
        );
    }
    let table: toml::Table = structure.text().parse().unwrap_or_default();
    let kind = table
        .get("model")
        .and_then(|model| model.get("kind"))
        .and_then(toml::Value::as_str)
        .unwrap_or("");
    let (added, labels) = match kind {
        "shear-building" => storeys(structure.degrees_of_freedom().len()),
        "bouc-wen" => {
            return without(
                structure,
                "the filter estimates no displacement of hysteretic springs",
            );
        }
        _ => at_sensors(&table),
    };
    let text = format!("{}\n{added}", structure.text());
    match Structure::parse(&text, path) {
        Ok(structure) if !labels.is_empty() => WithDisplacements {
            structure,
            labels,
            missing: None,
        },
        Ok(_) | Err(_) => without(structure, "the model states no relative displacement"),
    }
}

/// Returns the tables of the drifts of a shear building.
fn storeys(count: usize) -> (String, Vec<String>) {
    let (mut text, mut labels) = (String::new(), Vec::new());
    for storey in 1..=count {
        let terms = match storey {
            1 => "dofs = [1]\ncoefficients = [1.0]".to_owned(),
            _ => format!(
                "dofs = [{storey}, {}]\ncoefficients = [1.0, -1.0]",
                storey - 1
            ),
        };
        // Writing to a string cannot fail.
        let _ = write!(
            text,
            "\n[[response]]\nname = \"event-drift-{storey}\"\nquantity = \"strain\"\n{terms}\n"
        );
        labels.push(format!("drift of storey {storey}"));
    }
    (text, labels)
}

/// Returns the tables of the displacements at the accelerations of a structure.
fn at_sensors(table: &toml::Table) -> (String, Vec<String>) {
    let (mut text, mut labels) = (String::new(), Vec::new());
    let array = |value: Option<&toml::Value>| -> Vec<toml::Value> {
        let array = value.and_then(toml::Value::as_array);
        array.cloned().unwrap_or_default()
    };
    for node in array(table.get("node")) {
        for channel in array(node.get("channel")) {
            let get = |key: &str| channel.get(key);
            let quantity = get("quantity").and_then(toml::Value::as_str);
            let is_acceleration = matches!(
                quantity,
                Some("absolute-acceleration" | "relative-acceleration" | "restoring-acceleration")
            );
            if let (true, Some(name), Some(dof)) = (
                is_acceleration,
                get("name").and_then(toml::Value::as_str),
                get("dof"),
            ) {
                let number = labels.len() + 1;
                // Writing to a string cannot fail.
                let _ = write!(
                    text,
                    "\n[[response]]\nname = \"event-displacement-{number}\"\n\
                     quantity = \"displacement\"\ndof = {dof}\n"
                );
                labels.push(format!("displacement at {name}"));
            }
        }
    }
    (text, labels)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(text: &str) -> WithDisplacements {
        let path = Path::new("structure.toml");
        with_displacements(Structure::parse(text, path).unwrap(), path)
    }

    #[test]
    fn shear_building_has_the_drift_of_each_storey() {
        let demo = of(include_str!(
            "../../../../docs/examples/shake-table-stiff.toml"
        ));
        let expected = [1, 2, 3].map(|storey| format!("drift of storey {storey}"));
        assert_eq!(demo.labels, expected);
        assert_eq!(demo.structure.estimated_responses()[1].terms().len(), 2);
    }

    #[test]
    fn hysteretic_structure_says_why_it_has_none() {
        let text = include_str!("../../../../docs/examples/hysteretic-oscillator.toml");
        let structure = Structure::parse(text, Path::new("structure.toml")).unwrap();
        let has_own = !structure.estimated_responses().is_empty();
        assert!(has_own || of(text).missing.is_some());
    }
}
