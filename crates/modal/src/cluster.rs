//! Automatic choice of modes: poles of different orders that agree form a cluster.

use crate::realisation::Pole;
use crate::shape::mac;

/// Largest distance |Δf|/f + (1 − MAC) of two poles of the same mode.
pub(crate) const DISTANCE: f64 = 0.02;
/// Smallest share of the orders in which a mode has a pole.
pub(crate) const SHARE_OF_ORDERS: f64 = 1.0 / 3.0;

/// Returns the distance of two poles, |Δf|/f + (1 − MAC).
fn distance(first: &Pole, second: &Pole) -> f64 {
    let mean = 0.5 * (first.frequency_hz + second.frequency_hz);
    (first.frequency_hz - second.frequency_hz).abs() / mean + 1.0 - mac(&first.shape, &second.shape)
}

/// Returns clusters of poles, each with at most one pole per order, in order of frequency.
///
/// `poles` contains the candidates of each order. The pole with the most neighbours in other orders
/// becomes the centre of the first cluster. Its neighbours leave, and the search repeats until no
/// centre has neighbours in a third of the orders. Poles with the same number of neighbours are
/// ranked by the sum of their distances.
pub(crate) fn clusters(poles: &[Vec<Pole>]) -> Vec<Vec<Pole>> {
    let all: Vec<(usize, &Pole)> = poles
        .iter()
        .enumerate()
        .flat_map(|(level, poles)| poles.iter().map(move |pole| (level, pole)))
        .collect();
    let mut free = vec![true; all.len()];
    let needed = (SHARE_OF_ORDERS * poles.len() as f64).ceil().max(2.0) as usize;
    let mut clusters = Vec::new();
    // Distances do not change, so each pair is computed once.
    let near: Vec<Vec<(usize, f64)>> = all.iter().map(|(_, pole)| neighbours(pole, &all)).collect();
    loop {
        let best = (0..all.len())
            .filter(|centre| free[*centre])
            .map(|centre| nearest_of_each_order(&near[centre], &all, &free, poles.len()))
            .max_by(|a, b| (a.len().cmp(&b.len())).then(total(b).total_cmp(&total(a))));
        let Some(members) = best.filter(|members| members.len() >= needed) else {
            break;
        };
        // Other poles of the same orders that are as near are copies of the same mode.
        for (position, _) in &members {
            free[*position] = false;
        }
        clusters.push(
            members
                .iter()
                .map(|(position, _)| all[*position].1.clone())
                .collect(),
        );
    }
    clusters.sort_by(|a: &Vec<Pole>, b| a[0].frequency_hz.total_cmp(&b[0].frequency_hz));
    clusters
}

/// Returns all poles within [`DISTANCE`] with their distances, including the pole itself.
fn neighbours(centre: &Pole, all: &[(usize, &Pole)]) -> Vec<(usize, f64)> {
    let is_far = |pole: &Pole| {
        (pole.frequency_hz - centre.frequency_hz).abs()
            > DISTANCE * pole.frequency_hz.max(centre.frequency_hz)
    };
    all.iter()
        .enumerate()
        .filter(|(_, (_, pole))| !is_far(pole))
        .map(|(position, (_, pole))| (position, distance(centre, pole)))
        .filter(|(_, distance)| *distance < DISTANCE)
        .collect()
}

/// Returns the nearest free neighbour of each order.
fn nearest_of_each_order(
    near: &[(usize, f64)],
    all: &[(usize, &Pole)],
    free: &[bool],
    levels: usize,
) -> Vec<(usize, f64)> {
    let mut nearest: Vec<Option<(usize, f64)>> = vec![None; levels];
    for &(position, distance) in near.iter().filter(|(position, _)| free[*position]) {
        let slot = &mut nearest[all[position].0];
        if slot.is_none_or(|(_, best)| distance < best) {
            *slot = Some((position, distance));
        }
    }
    nearest.into_iter().flatten().collect()
}

fn total(members: &[(usize, f64)]) -> f64 {
    members.iter().map(|(_, distance)| distance).sum()
}
