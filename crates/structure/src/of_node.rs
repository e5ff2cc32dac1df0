//! Views of the structure for one sensor node: the same model with the channels known to that node.

use crate::node::Node;
use crate::noise_level::{NoiseLevel, NoiseSource};
use crate::structure::Structure;

impl Structure {
    /// Returns the structure with the channels and sampling rate of one node; `None` if it does not
    /// exist.
    ///
    /// The node does not know an excitation that another node measures. White noise at a lower
    /// sampling rate is the same process: the product of variance and time step is constant.
    #[must_use]
    pub fn of_node(&self, name: &str) -> Option<Self> {
        let position = self.nodes.iter().position(|node| node.name() == name)?;
        let node = self.nodes[position].clone();
        let own = self.channels_of(position);
        let first = own.start;
        let own_channel = |channel: usize| own.contains(&channel).then(|| channel - first);
        let sampling_rate_hz = node.sampling_rate_hz().unwrap_or(self.sampling_rate_hz);

        let mut excitations = self.excitations.clone();
        for excitation in &mut excitations {
            excitation.measured = excitation.measured.and_then(|mut measured| {
                measured.channel = own_channel(measured.channel)?;
                Some(measured)
            });
            excitation.std *= (sampling_rate_hz / self.sampling_rate_hz).sqrt();
        }
        let rows: Vec<usize> = (0..self.observation_channels.len())
            .filter(|row| own.contains(&self.observation_channels[*row]))
            .collect();
        let level = |level: &NoiseLevel| {
            let mut level = level.clone();
            match &mut level.source {
                NoiseSource::Excitation(index) => level.std = excitations[*index].unknown_std(),
                NoiseSource::Sensors(of_group) => {
                    *of_group = of_group
                        .iter()
                        .filter_map(|row| rows.iter().position(|own| own == row))
                        .collect();
                    if of_group.is_empty() {
                        return None;
                    }
                }
            }
            Some(level)
        };
        let noise_levels = self.noise_levels.iter().filter_map(level).collect();
        let mut simulation = self.simulation.clone();
        simulation.clock_offsets_s = vec![self.simulation.clock_offsets_s[position]];
        simulation.clock_drifts_ppm = vec![self.simulation.clock_drifts_ppm[position]];
        simulation.faults.retain(|fault| fault.node == position);
        simulation
            .faults
            .iter_mut()
            .for_each(|fault| fault.node = 0);
        simulation.levels.clear(); // their indices refer to the whole structure, which is simulated
        Some(Self {
            sampling_rate_hz,
            excitation_channels: excitations
                .iter()
                .flat_map(|excitation| {
                    std::iter::repeat_n(excitation.channel(), excitation.component_len())
                })
                .collect(),
            observation_channels: rows
                .iter()
                .map(|row| self.observation_channels[*row] - first)
                .collect(),
            excitations,
            nodes: vec![Node {
                sampling_rate_hz: None,
                ..node
            }],
            noise_levels,
            classes: None,
            fusion: None,
            simulation,
            ..self.clone()
        })
    }

    /// Returns the structure with the observation channels of all nodes, at the rate of one node.
    ///
    /// This is the structure of the node at `position` if nodes exchange samples. It knows only the
    /// excitation that this node measures. The result is `None` if the node does not exist.
    pub(crate) fn with_samples_of_others(&self, position: usize) -> Option<Self> {
        let of_node = self.of_node(self.nodes.get(position)?.name())?;
        let first = self.channels_of(position).start;
        let mut noise_levels = self.noise_levels.clone();
        for level in &mut noise_levels {
            if let NoiseSource::Excitation(index) = level.source {
                level.std = of_node.excitations[index].unknown_std();
            }
        }
        Some(Self {
            sampling_rate_hz: of_node.sampling_rate_hz,
            excitation_channels: of_node
                .excitation_channels
                .iter()
                .map(|channel| channel.map(|own| own + first))
                .collect(),
            excitations: of_node.excitations,
            noise_levels,
            classes: None,
            ..self.clone()
        })
    }

    /// Returns the number of observation channels of each node.
    pub(crate) fn observations_by_node(&self) -> Vec<usize> {
        let of = |position| {
            let own = self.channels_of(position);
            self.observation_channels
                .iter()
                .filter(|channel| own.contains(channel))
                .count()
        };
        (0..self.nodes.len()).map(of).collect()
    }

    /// Returns the unit exponents of exchanged samples, one per observation.
    pub(crate) fn sample_units(&self) -> Vec<i16> {
        let channels: Vec<&crate::Channel> =
            self.nodes.iter().flat_map(|node| node.channels()).collect();
        let exponent = |channel: &usize| {
            spandrel_filter::fusion::unit_exponent(channels[*channel].noise_std())
        };
        self.observation_channels.iter().map(exponent).collect()
    }

    /// Returns the range of a node's channels in the whole structure.
    fn channels_of(&self, position: usize) -> std::ops::Range<usize> {
        let first: usize = self.nodes[..position]
            .iter()
            .map(|node| node.channels().len())
            .sum();
        first..first + self.nodes[position].channels().len()
    }
}

#[cfg(test)]
mod tests {
    use crate::Structure;
    use std::path::Path;

    fn demo() -> Structure {
        let text = include_str!("../../../docs/examples/demo.toml");
        Structure::parse(text, Path::new("demo.toml")).unwrap()
    }

    #[test]
    fn node_observes_only_its_own_channels_and_excitation() {
        let floor = demo().of_node("floor-3").unwrap();
        assert_eq!(floor.channel_count(), 1);
        assert_eq!(
            (floor.observation_channels(), floor.excitation_channels()),
            (&[0][..], &[None][..])
        );
        let names: Vec<&str> = floor
            .noise_levels()
            .iter()
            .map(|level| level.name())
            .collect();
        assert_eq!(names, ["ground", "floors"]);
        // The standard deviation of the ground motion itself, not of the sensor noise on the
        // ground.
        assert_eq!(floor.noise_levels()[0].std(), 0.1);
        let model = floor.model();
        assert_eq!(
            spandrel_filter::ObservationModel::observation_len(&model),
            1
        );
        assert!(demo().of_node("floor-9").is_none());
    }

    #[test]
    fn node_that_measures_the_excitation_uses_it_as_known() {
        let ground = demo().of_node("ground").unwrap();
        assert_eq!(
            (ground.observation_channels(), ground.excitation_channels()),
            (&[][..], &[Some(0)][..])
        );
        assert_eq!(ground.noise_levels()[0].std(), 0.005);
    }

    #[test]
    fn slower_node_has_the_same_spectral_density_of_white_noise() {
        let text = include_str!("../../../docs/examples/demo.toml").replace(
            "name = \"floor-3\"\n\n[[node.channel]]",
            "name = \"floor-3\"\nsampling-rate-hz = 50\n\n[[node.channel]]",
        );
        let structure = Structure::parse(&text, Path::new("slow.toml")).unwrap();
        let floor = structure.of_node("floor-3").unwrap();
        assert_eq!(floor.sampling_rate_hz(), 50.0);
        assert!((floor.noise_levels()[0].std() - 0.1 / 2f64.sqrt()).abs() < 1e-15);
    }
}
