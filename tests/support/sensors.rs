//! Sensor nodes that the test simulates, correct and faulty ones.

use super::Record;
use spandrel_bus::{
    Block, Bus, Header, Keep, Keys, LiveToken, Name, NumberedPublisher, NumberedStream, Pace,
    SampleBlock, Service, StreamState,
};
use spandrel_structure::Structure;
use std::ops::Range;

/// All nodes of a structure with the samples of a record, live.
pub struct Sensors {
    nodes: Vec<Node>,
    record: Record,
}

/// One node.
pub struct Node {
    pub name: Name,
    pub key: String,
    epoch: u64,
    next: u64,
    channels: Vec<String>,
    publisher: NumberedPublisher<SampleBlock>,
    _token: LiveToken,
}

impl Sensors {
    /// Announces all nodes of a structure.
    pub async fn start(bus: &Bus, keys: &Keys, structure: &Structure, record: &Record) -> Self {
        let mut nodes = Vec::new();
        for node in structure.nodes() {
            let channels = node
                .channels()
                .iter()
                .map(|channel| channel.name().to_owned())
                .collect();
            nodes.push(Node::start(bus, keys, Name::new(node.name()).unwrap(), channels, 1).await);
        }
        Self {
            nodes,
            record: record.clone(),
        }
    }

    pub fn node(&mut self, name: &str) -> &mut Node {
        self.nodes
            .iter_mut()
            .find(|node| node.name.as_str() == name)
            .unwrap()
    }

    /// Returns the names of the nodes.
    pub fn names(&self) -> Vec<String> {
        self.nodes
            .iter()
            .map(|node| node.name.to_string())
            .collect()
    }

    /// Returns the record that the nodes send.
    pub fn record(&self) -> &Record {
        &self.record
    }

    /// Publishes rows of the record, a block per node.
    pub async fn put(&mut self, rows: Range<usize>) {
        self.put_all_but(&[], rows).await;
    }

    /// Publishes rows of the record, except those of some nodes.
    pub async fn put_all_but(&mut self, without: &[&str], rows: Range<usize>) {
        for node in self
            .nodes
            .iter_mut()
            .filter(|node| !without.contains(&node.name.as_str()))
        {
            let block = node.block(&self.record, rows.clone());
            node.put(block).await;
        }
    }

    /// Publishes rows of the record of one node, changed by `change`.
    pub async fn put_changed(
        &mut self,
        name: &str,
        rows: Range<usize>,
        change: impl FnOnce(&mut SampleBlock),
    ) {
        let record = self.record.clone();
        let node = self.node(name);
        let mut block = node.block(&record, rows);
        change(&mut block);
        node.put(block).await;
    }

    /// Removes a node without notice. Its token disappears with its session.
    pub fn remove(&mut self, name: &str) -> Node {
        let index = self
            .nodes
            .iter()
            .position(|node| node.name.as_str() == name)
            .unwrap();
        self.nodes.remove(index)
    }

    pub fn add(&mut self, node: Node) {
        self.nodes.push(node);
    }
}

impl Node {
    pub async fn start(
        bus: &Bus,
        keys: &Keys,
        name: Name,
        channels: Vec<String>,
        epoch: u64,
    ) -> Self {
        let stream = NumberedStream {
            key: keys.samples(&name),
            buffer_key: keys.buffer(&name),
            source: name.to_string(),
            epoch,
            first: 0,
            state: StreamState::Running,
            keep: Keep::last(1 << 16),
        };
        let publisher = bus.publish_numbered(stream).await.unwrap();
        let token = bus
            .announce(keys.live(Service::Sensor, &name))
            .await
            .unwrap();
        Self {
            key: keys.samples(&name),
            name,
            epoch,
            next: 0,
            channels,
            publisher,
            _token: token,
        }
    }

    /// Returns the next block of this node, with rows of a record.
    pub fn block(&self, record: &Record, rows: Range<usize>) -> SampleBlock {
        let samples = rows.clone().flat_map(|row| {
            self.channels
                .iter()
                .map(move |name| record.value(row, name))
        });
        SampleBlock {
            header: Header {
                source: self.name.to_string(),
                epoch: self.epoch,
                sequence: self.next,
                time_ns: record.time_ns(rows.start),
            },
            sampling_rate_hz: 100.0,
            pace: Pace::Live,
            channels: self.channels.len() as u16,
            samples: samples.collect(),
            state: StreamState::Running,
            clock_quality: None,
        }
    }

    pub async fn put(&mut self, block: SampleBlock) {
        self.next = block.end();
        self.publisher.put(block).await.unwrap();
    }

    /// Returns the names of its channels.
    pub fn channels(&self) -> &[String] {
        &self.channels
    }
}

/// Publishes any bytes with any encoding, and waits for the network to accept them.
pub async fn put_raw(bus: &Bus, key: &str, encoding: &str, payload: Vec<u8>) {
    let put = bus
        .session()
        .put(key, payload)
        .encoding(encoding)
        .congestion_control(zenoh::qos::CongestionControl::Block);
    put.await.unwrap();
}
