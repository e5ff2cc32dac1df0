//! Reports nodes whose source states a low quality of its clock.

/// Quality below which the clock of a node is reported, per cent.
///
/// The manuals leave the scale to the manufacturer. Usually, 100 per cent is a clock with the
/// stated accuracy. The value falls while a clock has no reference such as GPS.
const LOW_BELOW: u8 = 50;
/// Quality from which a clock can be reported again, per cent. A quality that varies around
/// [`LOW_BELOW`] is reported once.
const GOOD_FROM: u8 = 60;

/// A node whose quality has become low.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LowQuality {
    /// Index of the node.
    pub(crate) node: usize,
    /// Stated quality, per cent.
    pub(crate) quality: u8,
}

impl LowQuality {
    /// Returns what happened, with the quality, and the reason with advice.
    pub(crate) fn describe(self) -> (String, String) {
        let what = format!(
            "the source of the node states a quality of its clock of {} %",
            self.quality
        );
        let why = format!(
            "less than {LOW_BELOW} % usually means that the clock has lost its reference; its \
             samples are used at the times that it states; check its time synchronisation"
        );
        (what, why)
    }
}

/// The last stated quality of each node, and whether it was reported.
#[derive(Debug)]
pub(crate) struct QualityWatch {
    nodes: Vec<Stated>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Stated {
    /// Per cent. `None` if the source states none.
    quality: Option<u8>,
    is_reported: bool,
}

impl QualityWatch {
    /// Creates the watch for `nodes` nodes.
    pub(crate) fn new(nodes: usize) -> Self {
        Self {
            nodes: vec![Stated::default(); nodes],
        }
    }

    /// Records the quality of a block, per cent. A block that was queried states none, and changes
    /// nothing.
    pub(crate) fn arrived(&mut self, node: usize, quality: Option<u8>) {
        if let (Some(stated), Some(_)) = (self.nodes.get_mut(node), quality) {
            stated.quality = quality;
        }
    }

    /// Forgets the quality of a node that has disappeared.
    pub(crate) fn forget(&mut self, node: usize) {
        if let Some(stated) = self.nodes.get_mut(node) {
            stated.quality = None;
        }
    }

    /// Returns the last stated quality of each node, per cent.
    pub(crate) fn qualities(&self) -> impl Iterator<Item = Option<u8>> {
        self.nodes.iter().map(|stated| stated.quality)
    }

    /// Returns the nodes whose quality has become low since the last call.
    pub(crate) fn read(&mut self) -> Vec<LowQuality> {
        let mut low = Vec::new();
        for (node, stated) in self.nodes.iter_mut().enumerate() {
            let Some(quality) = stated.quality else {
                continue;
            };
            if quality >= GOOD_FROM {
                stated.is_reported = false;
            } else if quality < LOW_BELOW && !stated.is_reported {
                stated.is_reported = true;
                low.push(LowQuality { node, quality });
            }
        }
        low
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn low_quality_is_reported_once_until_it_was_good() {
        let mut watch = QualityWatch::new(2);
        let mut reported = |quality: Option<u8>| {
            watch.arrived(1, quality);
            watch.read()
        };
        let low = |quality| vec![LowQuality { node: 1, quality }];
        assert_eq!(reported(Some(50)), []);
        assert_eq!(reported(Some(49)), low(49));
        for quality in [Some(10), Some(55), None, Some(30)] {
            assert_eq!(reported(quality), [], "{quality:?}");
        }
        assert_eq!(reported(Some(60)), []);
        assert_eq!(reported(Some(20)), low(20));
        let (what, why) = LowQuality {
            node: 1,
            quality: 20,
        }
        .describe();
        assert!(what.ends_with("clock of 20 %"), "{what}");
        assert!(why.starts_with("less than 50 %"), "{why}");
    }

    #[test]
    fn last_stated_quality_remains_until_the_node_disappears() {
        let mut watch = QualityWatch::new(2);
        watch.arrived(0, Some(80));
        watch.arrived(0, None);
        assert_eq!(watch.qualities().collect::<Vec<_>>(), [Some(80), None]);
        watch.forget(0);
        assert_eq!(watch.qualities().collect::<Vec<_>>(), [None, None]);
    }
}
