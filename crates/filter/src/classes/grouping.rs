//! The grouping of components that share a multiplier.

use crate::error::FilterError;
use serde::{Deserialize, Serialize};

/// A partition of the components of a structure.
///
/// The components of a group share one stiffness multiplier.
///
/// Source: Huang & Yuen (2023), (5.36) to (5.39).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Grouping {
    groups: Vec<Vec<usize>>,
    group_of: Vec<usize>,
}

impl Grouping {
    /// Creates a partition from groups of components (numbered from 0).
    ///
    /// All components that belong to none of `groups` form one additional group at the end.
    ///
    /// # Errors
    /// Returns an error if a group is empty, or if a component does not exist or occurs twice.
    pub fn new(mut groups: Vec<Vec<usize>>, components: usize) -> Result<Self, FilterError> {
        let mut group_of = vec![usize::MAX; components];
        for (group, members) in groups.iter().enumerate() {
            if members.is_empty() {
                let (what, allowed) = ("number of components of a group", "at least 1");
                return Err(FilterError::Setting {
                    what,
                    found: 0.0,
                    allowed,
                });
            }
            for &component in members {
                let free = group_of
                    .get_mut(component)
                    .filter(|group| **group == usize::MAX);
                let Some(entry) = free else {
                    let (what, allowed) = (
                        "component of a group",
                        "below the number of components and in one group",
                    );
                    return Err(FilterError::Setting {
                        what,
                        found: component as f64,
                        allowed,
                    });
                };
                *entry = group;
            }
        }
        let rest: Vec<usize> = (0..components)
            .filter(|component| group_of[*component] == usize::MAX)
            .collect();
        if !rest.is_empty() {
            for &component in &rest {
                group_of[component] = groups.len();
            }
            groups.push(rest);
        }
        Ok(Self { groups, group_of })
    }

    /// Returns the baseline, (5.41): one multiplier for all `components`.
    #[must_use]
    pub fn together(components: usize) -> Self {
        Self {
            groups: vec![(0..components).collect()],
            group_of: vec![0; components],
        }
    }

    /// Returns a partition with one multiplier for `members` and one for the rest, (5.43) and
    /// (5.59).
    ///
    /// # Errors
    /// Returns the same errors as [`Grouping::new`].
    pub fn apart(members: Vec<usize>, components: usize) -> Result<Self, FilterError> {
        Self::new(vec![members], components)
    }

    /// Returns the components of each group.
    #[must_use]
    pub fn groups(&self) -> &[Vec<usize>] {
        &self.groups
    }

    /// Returns the index of the group that contains a component.
    #[must_use]
    pub fn group_of(&self, component: usize) -> usize {
        self.group_of[component]
    }

    /// Returns `true` if both partitions have the same groups, in any order.
    #[must_use]
    pub fn is_same_partition(&self, other: &Self) -> bool {
        let both = || self.group_of.iter().zip(&other.group_of);
        self.components() == other.components()
            && self.groups.len() == other.groups.len()
            && both().enumerate().all(|(n, (one, another))| {
                both()
                    .take(n)
                    .all(|(earlier, earlier_other)| (one == earlier) == (another == earlier_other))
            })
    }

    /// Returns the number of components.
    #[must_use]
    pub fn components(&self) -> usize {
        self.group_of.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn components_in_no_group_form_the_last_one() {
        let grouping = Grouping::new(vec![vec![3], vec![0, 1]], 5).unwrap();
        assert_eq!(grouping.groups(), [vec![3], vec![0, 1], vec![2, 4]]);
        assert_eq!(
            (0..5).map(|n| grouping.group_of(n)).collect::<Vec<_>>(),
            [1, 1, 2, 0, 2]
        );
    }

    #[test]
    fn order_of_groups_does_not_change_the_partition() {
        let grouping = |groups: &[&[usize]]| {
            Grouping::new(groups.iter().map(|g| g.to_vec()).collect(), 4).unwrap()
        };
        assert!(grouping(&[&[0, 1], &[2]]).is_same_partition(&grouping(&[&[3], &[2], &[1, 0]])));
        assert!(!grouping(&[&[0, 1], &[2]]).is_same_partition(&grouping(&[&[0, 2], &[1]])));
        assert!(
            !grouping(&[&[0], &[1], &[2, 3]]).is_same_partition(&grouping(&[&[0], &[1, 2, 3]]))
        );
    }

    #[test]
    fn a_component_twice_or_beyond_the_last_is_refused() {
        for groups in [vec![vec![0], vec![0]], vec![vec![2]], vec![vec![]]] {
            assert!(Grouping::new(groups, 2).is_err());
        }
    }
}
