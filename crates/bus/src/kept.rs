//! Storage of encoded blocks in pages.
//!
//! Live blocks are small. A separate allocation for each block would take one and a half times the
//! memory.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Size of a page in bytes. For a building of five storeys and blocks of 50 ms, it contains about
/// fifteen blocks of estimates, or fifty blocks of frames.
const PAGE_BYTES: usize = 16 << 10;
/// Size from which a block has its own page, of exactly its size.
const OWN_PAGE_BYTES: usize = PAGE_BYTES / 8;

/// A stored block as it was published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Kept<'a> {
    pub(crate) sequence: u64,
    pub(crate) count: u64,
    pub(crate) payload: &'a [u8],
    pub(crate) put_at: Instant,
}

impl Kept<'_> {
    pub(crate) fn end(&self) -> u64 {
        self.sequence + self.count
    }
}

/// Blocks in order. Each block starts at the end of the previous block.
#[derive(Clone, Debug, Default)]
pub(crate) struct KeptBlocks {
    pages: VecDeque<Page>,
    blocks: usize,
}

/// Several consecutive blocks. The bytes of dropped blocks are freed with the whole page.
#[derive(Clone, Debug)]
struct Page {
    /// Number of the first item of the first block, and the publication time of this block.
    first: u64,
    begun: Instant,
    bytes: Vec<u8>,
    ends: Vec<BlockEnd>,
    forgotten: usize,
}

/// End of a block in its page: items and bytes since the start of the page. The publication time is
/// relative to that of the page.
#[derive(Clone, Copy, Debug, Default)]
struct BlockEnd {
    items: u32,
    bytes: u32,
    after_ms: u32,
}

impl Page {
    fn new(first: u64, begun: Instant, bytes: Vec<u8>) -> Self {
        Self {
            first,
            begun,
            bytes,
            ends: Vec::new(),
            forgotten: 0,
        }
    }

    fn has_room_for(&self, payload: &[u8]) -> bool {
        self.bytes.capacity() - self.bytes.len() >= payload.len()
    }

    /// Records a block whose bytes are already in the page.
    fn note(&mut self, count: u64, put_at: Instant) {
        let before = self.ends.last().copied().unwrap_or_default();
        // A page has at most 16 KiB of blocks of at most 65,536 items.
        let items = before
            .items
            .saturating_add(u32::try_from(count).unwrap_or(u32::MAX));
        let after_ms =
            u32::try_from(put_at.duration_since(self.begun).as_millis()).unwrap_or(u32::MAX);
        self.ends.push(BlockEnd {
            items,
            bytes: self.bytes.len() as u32,
            after_ms,
        });
    }

    fn get(&self, index: usize) -> Option<Kept<'_>> {
        let end = self.ends.get(index)?;
        let before = index
            .checked_sub(1)
            .and_then(|before| self.ends.get(before))
            .copied()
            .unwrap_or_default();
        Some(Kept {
            sequence: self.first + u64::from(before.items),
            count: u64::from(end.items - before.items),
            payload: self.bytes.get(before.bytes as usize..end.bytes as usize)?,
            put_at: self.begun + Duration::from_millis(end.after_ms.into()),
        })
    }

    fn end(&self) -> u64 {
        self.first + self.ends.last().map_or(0, |end| u64::from(end.items))
    }

    fn is_empty(&self) -> bool {
        self.forgotten == self.ends.len()
    }
}

impl KeptBlocks {
    pub(crate) fn len(&self) -> usize {
        self.blocks
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.blocks == 0
    }

    /// Adds a block that starts at `sequence`, where the previous block ends.
    pub(crate) fn push(&mut self, sequence: u64, count: u64, payload: &[u8], put_at: Instant) {
        self.blocks += 1;
        if payload.len() < OWN_PAGE_BYTES {
            let page = match self
                .pages
                .back_mut()
                .filter(|page| page.has_room_for(payload))
            {
                Some(page) => page,
                None => self.pages.push_back_mut(Page::new(
                    sequence,
                    put_at,
                    Vec::with_capacity(PAGE_BYTES),
                )),
            };
            page.bytes.extend_from_slice(payload);
            return page.note(count, put_at);
        }
        let mut page = Page::new(sequence, put_at, payload.to_vec());
        page.note(count, put_at);
        self.pages.push_back(page);
    }

    pub(crate) fn front(&self) -> Option<Kept<'_>> {
        self.pages.front().and_then(|page| page.get(page.forgotten))
    }

    pub(crate) fn back(&self) -> Option<Kept<'_>> {
        self.pages
            .back()
            .and_then(|page| page.get(page.ends.len().checked_sub(1)?))
    }

    /// Removes the first block.
    pub(crate) fn pop_front(&mut self) {
        if let Some(page) = self.pages.front_mut() {
            page.forgotten += 1;
            self.blocks -= 1;
        }
        self.pages.pop_front_if(|page| page.is_empty());
    }

    /// Removes the last block.
    pub(crate) fn pop_back(&mut self) {
        if let Some(page) = self.pages.back_mut() {
            page.ends.pop();
            page.bytes
                .truncate(page.ends.last().map_or(0, |end| end.bytes as usize));
            self.blocks -= 1;
        }
        self.pages.pop_back_if(|page| page.is_empty());
    }

    /// Iterates over the blocks, starting with the first block that ends after item `number`.
    pub(crate) fn after(&self, number: u64) -> impl Iterator<Item = Kept<'_>> {
        let page = self.pages.partition_point(|page| page.end() <= number);
        let blocks = self
            .pages
            .iter()
            .skip(page)
            .flat_map(|page| (page.forgotten..).map_while(|index| page.get(index)));
        blocks.skip_while(move |block| block.end() <= number)
    }

    /// Returns the memory of the blocks, in bytes.
    #[cfg(test)]
    pub(crate) fn bytes(&self) -> usize {
        let of_page =
            |page: &Page| page.bytes.capacity() + page.ends.capacity() * size_of::<BlockEnd>();
        self.pages.iter().map(of_page).sum::<usize>() + self.pages.capacity() * size_of::<Page>()
    }
}

#[cfg(test)]
#[expect(
    clippy::disallowed_methods,
    reason = "origin of the fixed times of the tests"
)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Number of the first item, number of items, bytes and publication time of a block.
    type Listed = (u64, u64, Vec<u8>, Instant);

    fn listed(kept: &KeptBlocks, after: u64) -> Vec<Listed> {
        kept.after(after)
            .map(|block| {
                (
                    block.sequence,
                    block.count,
                    block.payload.to_vec(),
                    block.put_at,
                )
            })
            .collect()
    }

    proptest! {
        #[test]
        fn stored_blocks_are_returned_unchanged_whichever_are_dropped(
            steps in prop::collection::vec((0_u8..8, 0_u64..7, prop_oneof![1_usize..300, 1_usize..6_000]), 1..400),
        ) {
            let start = Instant::now();
            let (mut kept, mut listing, mut next) = (KeptBlocks::default(), VecDeque::<Listed>::new(), 5_u64);
            for (step, (what, count, bytes)) in steps.into_iter().enumerate() {
                match what {
                    0 => {
                        kept.pop_front();
                        listing.pop_front();
                    }
                    1 => {
                        kept.pop_back();
                        if let Some((sequence, ..)) = listing.pop_back() {
                            next = sequence;
                        }
                    }
                    _ => {
                        let put_at = start + Duration::from_millis(step as u64 * 50);
                        let payload = vec![step as u8; bytes];
                        kept.push(next, count, &payload, put_at);
                        listing.push_back((next, count, payload, put_at));
                        next += count;
                    }
                }
                prop_assert_eq!((kept.len(), kept.is_empty()), (listing.len(), listing.is_empty()));
                prop_assert_eq!(kept.front().map(|block| block.sequence), listing.front().map(|block| block.0));
                prop_assert_eq!(kept.back().map(|block| block.end()), listing.back().map(|block| block.0 + block.1));
            }
            for after in [0, next / 2, next] {
                let behind = |block: &&Listed| block.0 + block.1 <= after;
                let expected: Vec<_> = listing.iter().skip_while(behind).cloned().collect();
                prop_assert_eq!(listed(&kept, after), expected);
            }
        }
    }

    #[test]
    fn small_blocks_take_little_more_than_their_bytes() {
        let (mut kept, now) = (KeptBlocks::default(), Instant::now());
        for block in 0..1640 {
            kept.push(5 * block, 5, &[7; 1_040], now); // 82 s of estimates of five storeys
        }
        let bytes = 1640 * 1_040;
        assert!(
            kept.bytes() < bytes + bytes / 10,
            "{} for {bytes}",
            kept.bytes()
        );
        (0..1639).for_each(|_| kept.pop_front());
        assert!(
            kept.bytes() < 2 * PAGE_BYTES + 128 * size_of::<Page>(),
            "{} for one block",
            kept.bytes()
        );
    }
}
