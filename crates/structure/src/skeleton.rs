//! Geometry of a model: points, and the straight lines between them.

use crate::mesh::Mesh;
use crate::tower::{Segment, WAYS};
use nalgebra::Vector3;
use std::ops::Range;

/// Points and lines of a model, in the coordinates of its file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Skeleton {
    /// Names as in the degrees of freedom `node-NAME-DIRECTION`, and coordinates (m).
    pub(crate) points: Vec<(String, Vector3<f64>)>,
    /// `true` for each point that cannot move in some direction.
    pub(crate) is_held: Vec<bool>,
    pub(crate) lines: Vec<Line>,
    /// Upward direction.
    pub(crate) up: Up,
}

/// A straight part of the model.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Line {
    /// Indices of the points that it joins (from 0).
    pub(crate) ends: [usize; 2],
    /// Substructures (from 0) of its stiffness.
    pub(crate) parts: Range<usize>,
}

/// Upward direction of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Up {
    /// `y`, for a plane model.
    Y,
    /// `z`, for a model in space.
    Z,
}

impl Skeleton {
    /// Returns the skeleton of a frame or truss, whose groups are its substructures.
    pub(crate) fn of_mesh(mesh: &Mesh) -> Self {
        let lines = mesh.groups.iter().enumerate().flat_map(|(part, group)| {
            group.members.iter().map(move |ends| Line {
                ends: *ends,
                parts: part..part + 1,
            })
        });
        Self {
            points: mesh
                .nodes
                .iter()
                .map(|node| (node.name.clone(), node.at))
                .collect(),
            is_held: mesh
                .nodes
                .iter()
                .map(|node| node.fixed.contains(&true))
                .collect(),
            lines: lines.collect(),
            up: if mesh.directions.contains(&"z") {
                Up::Z
            } else {
                Up::Y
            },
        }
    }

    /// Returns the skeleton of a tower, in which each segment has one substructure per way of
    /// bending.
    pub(crate) fn of_tower(segments: &[Segment]) -> Self {
        let mut points = vec![("0".to_owned(), Vector3::zeros())];
        let mut lines = Vec::new();
        let mut foot_m = 0.0;
        for (index, segment) in segments.iter().enumerate() {
            for beam in 1..=segment.elements {
                let height = foot_m + segment.height_m * beam as f64 / segment.elements as f64;
                lines.push(Line {
                    ends: [points.len() - 1, points.len()],
                    parts: index * WAYS.len()..(index + 1) * WAYS.len(),
                });
                points.push((points.len().to_string(), Vector3::new(0.0, 0.0, height)));
            }
            foot_m += segment.height_m;
        }
        let is_held = (0..points.len()).map(|point| point == 0).collect();
        Self {
            points,
            is_held,
            lines,
            up: Up::Z,
        }
    }
}
