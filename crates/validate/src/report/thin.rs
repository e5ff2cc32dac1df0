//! Thinning of curves to the resolution of a diagram.

/// Distance below which a point counts as lying on a line (pixels).
const TOLERANCE: f32 = 0.6;
/// Width of a column in which a curve keeps its ends and extremes (pixels).
const COLUMN: f32 = 1.5;
/// Side of a cell that keeps one single point (pixels).
const CELL: f32 = 3.0;

/// A linear map from the coordinates of a diagram to pixels.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pixels {
    pub(super) left: f32,
    pub(super) low: f32,
    /// Pixels per unit of the abscissa and of the ordinate.
    pub(super) scale: (f32, f32),
}

impl Pixels {
    fn of(&self, point: (f32, f32)) -> (f32, f32) {
        (
            (point.0 - self.left) * self.scale.0,
            (point.1 - self.low) * self.scale.1,
        )
    }

    /// Returns the points of a curve that cannot be omitted without a visible change.
    pub(super) fn curve(&self, points: &[(f32, f32)]) -> Vec<(f32, f32)> {
        let mut kept: Vec<(f32, f32)> = Vec::new();
        let column = |point: &(f32, f32)| (self.of(*point).0 / COLUMN).floor() as i64;
        for run in points.chunk_by(|a, b| column(a) == column(b)) {
            let by_height = |a: &&usize, b: &&usize| run[**a].1.total_cmp(&run[**b].1);
            let all: Vec<usize> = (0..run.len()).collect();
            let extremes = all
                .iter()
                .min_by(by_height)
                .into_iter()
                .chain(all.iter().max_by(by_height))
                .copied();
            let mut chosen: Vec<usize> = [0, run.len() - 1].into_iter().chain(extremes).collect();
            chosen.sort_unstable();
            chosen.dedup();
            kept.extend(chosen.into_iter().map(|i| run[i]));
        }
        self.without_straight_stretches(&kept)
    }

    /// Omits points close to the line between their kept neighbours.
    ///
    /// Source: Douglas & Peucker (1973).
    fn without_straight_stretches(&self, points: &[(f32, f32)]) -> Vec<(f32, f32)> {
        let pixels: Vec<(f32, f32)> = points.iter().map(|point| self.of(*point)).collect();
        let mut kept = vec![false; points.len()];
        let mut stretches: Vec<(usize, usize)> = points
            .len()
            .checked_sub(1)
            .map(|last| (0, last))
            .into_iter()
            .collect();
        while let Some((from, to)) = stretches.pop() {
            (kept[from], kept[to]) = (true, true);
            let off = |i: &usize| distance(pixels[*i], pixels[from], pixels[to]);
            let farthest = (from + 1..to).max_by(|a, b| off(a).total_cmp(&off(b)));
            if let Some(middle) = farthest.filter(|i| off(i) > TOLERANCE) {
                stretches.extend([(from, middle), (middle, to)]);
            }
        }
        points
            .iter()
            .zip(kept)
            .filter(|(_, kept)| *kept)
            .map(|(point, _)| *point)
            .collect()
    }

    /// Returns one point of each small cell.
    pub(super) fn cloud(&self, points: &[(f32, f32)]) -> Vec<(f32, f32)> {
        let mut taken = std::collections::HashSet::new();
        let cell = |point: &(f32, f32)| {
            let (x, y) = self.of(*point);
            ((x / CELL).floor() as i64, (y / CELL).floor() as i64)
        };
        points
            .iter()
            .filter(|point| taken.insert(cell(point)))
            .copied()
            .collect()
    }
}

/// Returns the distance of a point from the line between two others, or from the first if both
/// coincide.
fn distance(point: (f32, f32), from: (f32, f32), to: (f32, f32)) -> f32 {
    let (along, across) = (
        (to.0 - from.0, to.1 - from.1),
        (point.0 - from.0, point.1 - from.1),
    );
    let length = along.0.hypot(along.1);
    match length > 0.0 {
        true => (along.0 * across.1 - along.1 * across.0).abs() / length,
        false => across.0.hypot(across.1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PIXELS: Pixels = Pixels {
        left: 0.0,
        low: 0.0,
        scale: (1.0, 1.0),
    };

    #[test]
    fn thinning_keeps_ends_and_corners() {
        let line: Vec<(f32, f32)> = (0..1000)
            .map(|i| (i as f32 * 0.6, i as f32 * 0.2))
            .collect();
        assert_eq!(PIXELS.curve(&line), [line[0], line[999]]);
        let corner: Vec<(f32, f32)> = (0..201)
            .map(|i| (i as f32, (i as f32 - 100.0).abs()))
            .collect();
        assert_eq!(PIXELS.curve(&corner), [corner[0], corner[100], corner[200]]);
        assert!(PIXELS.curve(&[]).is_empty());
        assert_eq!(PIXELS.curve(&[(1.0, 2.0)]), [(1.0, 2.0)]);
    }

    #[test]
    fn thinning_keeps_a_peak_of_one_sample() {
        let mut points: Vec<(f32, f32)> = (0..100_000).map(|i| (i as f32 * 0.006, 10.0)).collect();
        points[54_321].1 = 90.0;
        let thin = PIXELS.curve(&points);
        assert!(
            thin.contains(&points[54_321]) && thin.len() < 10,
            "{thin:?}"
        );
    }

    #[test]
    fn each_cell_of_a_cloud_keeps_one_point() {
        let points: Vec<(f32, f32)> = (0..9000)
            .map(|i| ((i % 90) as f32 / 10.0, (i / 90) as f32 * 0.09))
            .collect();
        assert_eq!(PIXELS.cloud(&points).len(), 9);
    }
}
