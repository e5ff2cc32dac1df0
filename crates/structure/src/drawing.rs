//! A drawing of a structure: points, members with their parameters, and sensors at their positions.

use crate::node::{Channel, Direction, Quantity};
use crate::parameter::Scales;
use crate::skeleton::{Skeleton, Up};
use crate::structure::Structure;
use nalgebra::Vector3;
use serde::Serialize;

/// Cosine and sine of the 30° projection of the horizontal axes of a model in space.
const OBLIQUE: (f64, f64) = (0.866_025_403_784_438_6, 0.5);

/// Kind of drawing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum DrawingForm {
    /// Floors above each other. Point 0 is the ground and point *n* is floor *n*; heights count
    /// storeys.
    Storeys,
    /// Straight members between points, in metres. A model in space is drawn obliquely from above.
    Members,
    /// Substructures without geometry, side by side.
    Boxes,
}

/// A structure drawn in a plane.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Drawing {
    /// Kind of drawing.
    pub form: DrawingForm,
    /// Points at which members meet.
    pub points: Vec<DrawnPoint>,
    /// Parts whose stiffness can be identified.
    pub members: Vec<DrawnMember>,
    /// Channels, in frame order.
    pub sensors: Vec<DrawnSensor>,
}

/// A point of a drawing.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DrawnPoint {
    /// Name in the structure file.
    pub name: String,
    /// Horizontal coordinate, positive to the right; in metres, storeys or boxes, depending on the
    /// form.
    pub x: f64,
    /// Vertical coordinate, positive upwards, in the same unit.
    pub y: f64,
    /// `true` if the point is fixed to the ground.
    pub held: bool,
}

/// A member of a drawing.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DrawnMember {
    /// Names of the substructures of the member; several if the member has one stiffness per
    /// bending direction.
    pub parts: Vec<String>,
    /// Indices of the points that the member joins (from 0); the same index twice for a box.
    pub ends: [usize; 2],
    /// Names of the parameters that scale its stiffness; empty if the stiffness is known.
    pub parameters: Vec<String>,
}

/// A channel of a drawing.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DrawnSensor {
    /// Name of the sensor node.
    pub node: String,
    /// Name of the channel.
    pub channel: String,
    /// Measured quantity.
    pub quantity: Quantity,
    /// SI unit of the quantity.
    pub unit: &'static str,
    /// `true` if the channel measures an excitation.
    pub excitation: bool,
    /// Point (from 0) of the sensor; `None` if the structure file does not specify it.
    pub point: Option<usize>,
    /// Direction of the sensor; `None` with a model, whose degrees of freedom have names.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub direction: Option<Direction>,
}

/// A drawing without its sensors.
struct Lines {
    form: DrawingForm,
    points: Vec<DrawnPoint>,
    members: Vec<DrawnMember>,
}

impl Structure {
    /// Returns the drawing of the structure.
    ///
    /// The form is storeys for chains of floors, members for models with coordinates, and boxes for
    /// matrices.
    #[must_use]
    pub fn drawing(&self) -> Drawing {
        let Lines {
            form,
            points,
            members,
        } = match &self.system.skeleton {
            Some(skeleton) => self.drawn_members(skeleton),
            None if !self.system.storeys.is_empty() => self.drawn_storeys(),
            None => self.drawn_boxes(),
        };
        let sensors = self.nodes.iter().flat_map(|node| {
            node.channels().iter().map(|channel| DrawnSensor {
                node: node.name().to_owned(),
                channel: channel.name().to_owned(),
                quantity: channel.quantity(),
                unit: channel.quantity().unit(),
                excitation: channel.quantity().is_excitation(),
                point: channel.point.or_else(|| self.place(channel, form, &points)),
                direction: channel.direction,
            })
        });
        let sensors = sensors.collect();
        Drawing {
            form,
            points,
            members,
            sensors,
        }
    }

    fn drawn_storeys(&self) -> Lines {
        let floors = std::iter::once("ground")
            .chain(self.system.degrees_of_freedom.iter().map(String::as_str));
        let point = |(level, name): (usize, &str)| DrawnPoint {
            name: name.to_owned(),
            x: 0.0,
            y: level as f64,
            held: level == 0,
        };
        let groups = self.system.storeys.iter().enumerate();
        let members = groups
            .flat_map(|(part, group)| group.storeys.clone().map(move |storey| (part, storey)))
            .map(|(part, storey)| self.drawn_member(part..part + 1, [storey, storey + 1]))
            .collect();
        Lines {
            form: DrawingForm::Storeys,
            points: floors.enumerate().map(point).collect(),
            members,
        }
    }

    fn drawn_members(&self, skeleton: &Skeleton) -> Lines {
        let points = skeleton
            .points
            .iter()
            .zip(&skeleton.is_held)
            .map(|((name, at), held)| {
                let (x, y) = seen(at, skeleton.up);
                DrawnPoint {
                    name: name.clone(),
                    x,
                    y,
                    held: *held,
                }
            });
        let members = skeleton
            .lines
            .iter()
            .map(|line| self.drawn_member(line.parts.clone(), line.ends));
        Lines {
            form: DrawingForm::Members,
            points: points.collect(),
            members: members.collect(),
        }
    }

    fn drawn_boxes(&self) -> Lines {
        let parts = || self.system.substructures.iter().enumerate();
        let points = parts().map(|(index, part)| DrawnPoint {
            name: part.name.clone(),
            x: index as f64,
            y: 0.0,
            held: false,
        });
        let members = parts().map(|(index, _)| self.drawn_member(index..index + 1, [index, index]));
        Lines {
            form: DrawingForm::Boxes,
            points: points.collect(),
            members: members.collect(),
        }
    }

    fn drawn_member(&self, parts: std::ops::Range<usize>, ends: [usize; 2]) -> DrawnMember {
        let scaled = |scales: &Scales| match scales {
            Scales::Stiffness(of) => of.iter().any(|part| parts.contains(part)),
            Scales::Mass(_) | Scales::Dashpots(_) | Scales::Hysteresis(_) => false,
            Scales::Damping | Scales::DampingAlpha | Scales::DampingBeta => false,
        };
        let parameters = self
            .parameters
            .iter()
            .filter(|parameter| scaled(&parameter.scales));
        let parameters = parameters.map(|parameter| parameter.name.clone()).collect();
        let parts = self.system.substructures[parts]
            .iter()
            .map(|part| part.name.clone())
            .collect();
        DrawnMember {
            parts,
            ends,
            parameters,
        }
    }

    /// Returns the point of a channel, if known.
    fn place(&self, channel: &Channel, form: DrawingForm, points: &[DrawnPoint]) -> Option<usize> {
        if channel.quantity() == Quantity::GroundAcceleration {
            return points.iter().position(|point| point.held);
        }
        let dof = channel.sensed.first()?.0;
        let name = self.system.degrees_of_freedom.get(dof)?;
        match form {
            DrawingForm::Storeys => points.iter().position(|point| point.name == *name),
            DrawingForm::Members => {
                let node = name.strip_prefix("node-")?.rsplit_once('-')?.0;
                points.iter().position(|point| point.name == node)
            }
            DrawingForm::Boxes => {
                let touches =
                    |part: &crate::linear_system::Substructure| part.stiffness.row(dof).nnz() > 0;
                self.system.substructures.iter().position(touches)
            }
        }
    }
}

/// Projects a point (m) onto the drawing: to the right and upwards.
fn seen(at: &Vector3<f64>, up: Up) -> (f64, f64) {
    let (cos, sin) = OBLIQUE;
    match up {
        Up::Y => (at.x, at.y),
        Up::Z => ((at.x - at.y) * cos, at.z + (at.x + at.y) * sin * sin),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn drawing(example: &str) -> Drawing {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples");
        Structure::read(&folder.join(example)).unwrap().drawing()
    }

    #[test]
    fn a_building_is_drawn_as_floors_with_its_sensors_on_them() {
        let demo = drawing("demo.toml");
        assert_eq!(
            (demo.form, demo.points.len(), demo.members.len()),
            (DrawingForm::Storeys, 6, 5)
        );
        let second = &demo.members[1];
        assert_eq!(
            (second.ends, second.parameters.as_slice()),
            ([1, 2], ["storey-2".to_owned()].as_slice())
        );
        let places: Vec<Option<usize>> = demo.sensors.iter().map(|sensor| sensor.point).collect();
        assert_eq!(places, [0, 1, 2, 3, 4, 5].map(Some));
        assert!(demo.sensors[0].excitation && !demo.sensors[1].excitation);
    }

    #[test]
    fn a_bridge_is_drawn_with_its_coordinates_deck_and_piers() {
        let bridge = drawing("three-pier-bridge.toml");
        let foot = bridge
            .points
            .iter()
            .find(|point| point.name == "21")
            .unwrap();
        assert_eq!(
            (bridge.form, foot.x, foot.y, foot.held),
            (DrawingForm::Members, 128.0, -16.0, true)
        );
        let piers = bridge
            .members
            .iter()
            .filter(|member| member.parameters == ["pier-middle"]);
        assert_eq!(
            piers
                .map(|member| member.ends.map(|end| bridge.points[end].name.clone()))
                .collect::<Vec<_>>(),
            [["9", "20"], ["20", "21"]]
        );
        assert!(bridge.sensors.iter().all(|sensor| sensor.point.is_some()));
    }

    #[test]
    fn tower_is_drawn_upright_and_its_beams_bend_in_both_directions() {
        let tower = drawing("tower.toml");
        assert!(tower.points.iter().all(|point| point.x == 0.0));
        assert_eq!(tower.points.last().unwrap().y, 610.0);
        assert_eq!(tower.members[0].parameters, ["along-x", "along-y"]);
        assert_eq!(tower.points[tower.sensors[0].point.unwrap()].name, "4");
    }

    #[test]
    fn dome_is_drawn_in_an_oblique_view() {
        let dome = drawing("dome.toml");
        let width = |of: fn(&DrawnPoint) -> f64| {
            let all = || dome.points.iter().map(of);
            all().fold(f64::MIN, f64::max) - all().fold(f64::MAX, f64::min)
        };
        assert!(width(|point| point.x) > 0.0 && width(|point| point.y) > 0.0);
        // Seen straight from above or from the front, some points would hide others.
        for (index, one) in dome.points.iter().enumerate() {
            let hidden = dome.points[..index]
                .iter()
                .any(|other| (one.x - other.x).hypot(one.y - other.y) < 1e-6);
            assert!(!hidden, "node {} is hidden", one.name);
        }
    }

    #[test]
    fn matrices_are_drawn_as_boxes() {
        let mast = drawing("matrices.toml");
        assert_eq!((mast.form, mast.points.len()), (DrawingForm::Boxes, 3));
        assert_eq!(mast.members[1].parameters, ["upper"]);
        let head = mast
            .sensors
            .iter()
            .find(|sensor| sensor.channel == "head")
            .unwrap();
        assert_eq!(mast.points[head.point.unwrap()].name, "upper");
    }

    #[test]
    fn every_example_can_be_drawn_with_all_its_stiffness_parameters() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples");
        let files = std::fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().path());
        for path in files.filter(|path| {
            path.extension()
                .is_some_and(|extension| extension == "toml")
        }) {
            let structure = Structure::read(&path).unwrap();
            let drawing = structure.drawing();
            for parameter in structure
                .parameters()
                .iter()
                .filter(|parameter| parameter.is_stiffness())
            {
                let name = parameter.name();
                let drawn = drawing
                    .members
                    .iter()
                    .any(|member| member.parameters.iter().any(|other| other == name));
                assert!(drawn, "{}: {name} is not drawn", path.display());
            }
        }
    }
}
