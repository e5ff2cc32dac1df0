//! The commands that work on recordings and files.

use super::shared::{BusArguments, ReadingArguments, ServiceArguments};
use super::values::{Band, below_1, not_negative, positive, seconds, share};
use clap::{Args, ValueEnum};
use spandrel_filter::ImportanceDensity;
use spandrel_identify::ParticlePlan;
use spandrel_validate::Seeds;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct JudgeArguments {
    /// CSV file with a time, the quantities and the conditions; may be repeated in the order of
    /// time.
    ///
    /// The structure file then needs no model.
    #[arg(long, value_name = "FILE")]
    pub series: Vec<PathBuf>,
    /// Print the false alarms that each reference promises and achieves, the losses that it misses,
    /// and the alarms so far.
    #[arg(long)]
    pub report: bool,
    /// Print one JSON object per line: every judgement of every day.
    #[arg(long)]
    pub json: bool,
    /// File judge-annotations.jsonl of the service judge. Its new references apply.
    #[arg(long, value_name = "FILE", requires = "series")]
    pub annotations: Option<PathBuf>,
    /// Write one row per quantity and day to this CSV file.
    #[arg(long, value_name = "FILE")]
    pub course: Option<PathBuf>,
    /// Repeat the judgement of the service at this time, with the configuration of that time.
    ///
    /// Seconds since 1970, UTC, or ISO 8601 such as 2026-03-01T12:00:00Z. The epochs and
    /// configurations are read from the state folder.
    #[arg(long, value_name = "TIME", conflicts_with_all = ["series", "report", "course"])]
    pub at: Option<String>,
    /// Configuration of the judgement, if several have judged the epoch [default: the first one].
    #[arg(long, value_name = "NAME", requires = "at")]
    pub with_configuration: Option<String>,
    #[command(flatten)]
    pub service: ServiceArguments,
    #[command(flatten)]
    pub example: ExampleArguments,
}

/// Options of the simulated series for practice.
#[derive(Debug, Args)]
#[command(next_help_heading = "Example series")]
pub struct ExampleArguments {
    /// Write a simulated series of a footbridge to this CSV file, instead of judging.
    ///
    /// It has four epochs a day with two natural frequencies and the temperature of the deck, from
    /// 1 July 2024 on.
    #[arg(long, value_name = "FILE")]
    #[arg(conflicts_with_all = [
        "series", "report", "json", "annotations", "course", "at", "with_configuration",
        "structures",
    ])]
    pub example: Option<PathBuf>,
    /// Length of the series (days).
    ///
    /// The default is a year to learn the reference, and a year to judge.
    #[arg(long, value_name = "N", default_value_t = 730, requires = "example")]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=3_653), allow_negative_numbers = true)]
    pub days: u32,
    /// Seed of weather and scatter.
    #[arg(long, value_name = "N", default_value_t = 1, requires = "example")]
    pub seed: u64,
    /// Share of the stiffness that the first mode loses, such as 0.05 [default: no loss].
    #[arg(
        long,
        value_name = "SHARE",
        requires = "example",
        requires = "loss_day"
    )]
    #[arg(value_parser = below_1, allow_negative_numbers = true)]
    pub loss: Option<f64>,
    /// Day of the loss, from 0.
    #[arg(long, value_name = "DAY", requires = "loss")]
    pub loss_day: Option<u32>,
    /// Day on which the loss is repaired [default: it remains].
    #[arg(long, value_name = "DAY", requires = "loss_day")]
    pub repair_day: Option<u32>,
}

#[derive(Debug, Args)]
pub struct EarthquakeArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Recordings of the events, including weak ones: files of any known format.
    ///
    /// They are sorted by their dates. Without dates, the given order counts.
    #[arg(required = true, value_name = "RECORD")]
    pub records: Vec<PathBuf>,
    /// Folder for the reports: EVENT.html and EVENT.json of each event, and index.html.
    ///
    /// The index lists all reports in the folder, including those of other structures.
    #[arg(long, value_name = "DIR")]
    pub report: PathBuf,
    /// Peak acceleration of the structure above which motion is strong (m/s²) [default: that of
    /// the table earthquakes of the structure file, otherwise 1].
    ///
    /// Only weaker motion can show a lasting loss.
    #[arg(long, value_name = "M/S2", value_parser = positive, allow_negative_numbers = true)]
    pub strong: Option<f64>,
    /// Loss of stiffness that matters, as a share [default: that of the table
    /// earthquakes, otherwise 0.05].
    #[arg(long, value_name = "SHARE", value_parser = below_1, allow_negative_numbers = true)]
    pub loss: Option<f64>,
    /// Minimum probability at which a loss is reported [default: that of the table earthquakes,
    /// otherwise 0.99].
    #[arg(long, value_name = "PROBABILITY", value_parser = below_1, allow_negative_numbers = true)]
    pub credibility: Option<f64>,
}

#[derive(Debug, Args)]
pub struct InfoArguments {
    /// Recording: a file of any known format, or a zip archive or folder of such files.
    pub record: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub reading: ReadingArguments,
}

#[derive(Debug, Args)]
pub struct ConvertArguments {
    /// Recording: a file of any known format, or a zip archive or folder of such files.
    pub record: PathBuf,
    /// Output file.
    ///
    /// Its extension determines the format.
    #[arg(value_name = "OUT.csv|OUT.mcap|OUT.mseed")]
    pub output: PathBuf,
    /// Resample all channels to this rate (Hz), with an anti-aliasing filter.
    #[arg(long, value_name = "HZ", value_parser = positive, allow_negative_numbers = true)]
    pub resample: Option<f64>,
    #[command(flatten)]
    pub reading: ReadingArguments,
}

#[derive(Debug, Args)]
pub struct ModesArguments {
    /// Recordings of one structure, and optionally a structure file (.toml). With --live, structure
    /// files [default: structures of the configuration].
    ///
    /// A recording is a file of any known format, or a zip archive or folder of such files. The
    /// files of a folder are separate recordings if they have the same channels.
    #[arg(value_name = "FILE", required_unless_present = "live")]
    pub files: Vec<PathBuf>,
    /// Run the service that follows the natural frequencies of live samples.
    #[arg(long, conflicts_with_all = [
        "structure", "channels", "without", "references", "epoch", "band", "order", "report",
        "json", "csv", "uff", "declare", "rate", "time_column", "time_unit",
    ])]
    pub live: bool,
    /// Structure file, for the columns, units and sampling rate of its channels [default: all
    /// channels of the recording].
    ///
    /// Its modal table applies, unless an option chooses channels, references, epoch, band or
    /// order.
    #[arg(long, value_name = "STRUCTURE.toml", conflicts_with_all = ["rate", "time_column", "time_unit"])]
    pub structure: Option<PathBuf>,
    /// Channels to use, separated by commas [default: all].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub channels: Vec<String>,
    /// Channels to leave out, separated by commas.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub without: Vec<String>,
    /// Reference channels, separated by commas [default: all, or 6 of a larger number].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub references: Vec<String>,
    /// Length of an epoch (s) [default: the recording in equal parts of about 600 s].
    #[arg(long, value_name = "SECONDS", value_parser = positive, allow_negative_numbers = true)]
    pub epoch: Option<f64>,
    /// Frequency band (Hz), such as 0.5..12 [default: several bands, up to 0.4 of the sampling
    /// rate].
    #[arg(long, value_name = "LOW..HIGH")]
    pub band: Option<Band>,
    /// Highest order of the models [default: 40].
    #[arg(long, value_name = "ORDER")]
    pub order: Option<usize>,
    /// Folder for the stabilisation diagram and the singular-value spectrum (SVG), and for the
    /// modes with their shapes (JSON) and of each epoch (CSV).
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
    /// Output file for the modes of each epoch, one row per epoch and mode.
    #[arg(long, value_name = "MODES.csv")]
    pub csv: Option<PathBuf>,
    /// Output file for the shapes and the spectral densities, as a universal file (datasets 55 and
    /// 58).
    #[arg(long, value_name = "MODES.uff")]
    pub uff: Option<PathBuf>,
    /// Print the modal tables for a structure file.
    #[arg(long, conflicts_with = "json")]
    pub declare: bool,
    #[command(flatten)]
    pub reading: ReadingArguments,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct EstimateArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// The recording.
    #[arg(long)]
    pub record: PathBuf,
    /// Output file for the mean and standard deviation of each parameter, response and adapted
    /// noise level, one row per frame.
    #[arg(long, value_name = "ESTIMATES.csv")]
    pub output: Option<PathBuf>,
    /// Baseline file, for alert rules with a learnt reference.
    #[arg(long, value_name = "BASELINE.json")]
    pub baseline: Option<PathBuf>,
    /// Filter for the identification.
    #[arg(long, value_enum, default_value_t = FilterChoice::File)]
    pub filter: FilterChoice,
    /// Print the summary as one JSON object.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub particle: ParticleArguments,
}

/// Filters of `spandrel estimate`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FilterChoice {
    /// The filter that the structure file specifies, as the services run it.
    File,
    /// The adaptive extended Kalman filter or the bank of model classes, even if the file specifies
    /// particles.
    Kalman,
    /// A particle filter for the model with all parameters, slow but without the assumption of
    /// Gaussian distributions.
    Particle,
}

/// Distribution from which particles are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum DensityChoice {
    /// Close to the next observation, by a Kalman filter for each particle.
    Optimal,
    /// From the model alone.
    Prior,
}

/// Options of the particle filter. [`ParticleArguments::plan`] supplies the defaults.
#[derive(Debug, Clone, Copy, Args)]
#[command(next_help_heading = "With --filter particle")]
pub struct ParticleArguments {
    /// Number of particles [default: 2000].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=10_000_000), allow_negative_numbers = true)]
    pub particles: Option<u32>,
    /// Distribution from which particles are drawn [default: optimal].
    #[arg(long, value_enum)]
    pub density: Option<DensityChoice>,
    /// Standard deviation of the drift of each parameter within a second, as a ratio to nominal per
    /// square root of a second [default: 0.005].
    #[arg(long, value_name = "RATIO", value_parser = not_negative, allow_negative_numbers = true)]
    pub drift: Option<f64>,
    /// Share of a particle's own state in resampling [default: 1].
    ///
    /// The rest is drawn from all particles. With 1, nothing is drawn from other particles.
    #[arg(long, value_name = "SHARE", value_parser = share, allow_negative_numbers = true)]
    pub kernel: Option<f64>,
    /// Time for which a Kalman filter runs before particles are drawn (s) [default: 2].
    #[arg(long, value_name = "SECONDS", value_parser = not_negative, allow_negative_numbers = true)]
    pub warm_up: Option<f64>,
    /// Seed of the random numbers [default: 0].
    #[arg(long)]
    pub seed: Option<u64>,
}

impl ParticleArguments {
    /// Returns the name of the first given option, or `None`. These options are valid only for the
    /// particle filter.
    pub fn given(&self) -> Option<&'static str> {
        let Self {
            particles,
            density,
            drift,
            kernel,
            warm_up,
            seed,
        } = self;
        let given = [
            (particles.is_some(), "--particles"),
            (density.is_some(), "--density"),
            (drift.is_some(), "--drift"),
            (kernel.is_some(), "--kernel"),
            (warm_up.is_some(), "--warm-up"),
            (seed.is_some(), "--seed"),
        ];
        given
            .into_iter()
            .find_map(|(is_given, option)| is_given.then_some(option))
    }

    /// Returns the plan of the particle filter.
    pub fn plan(&self) -> ParticlePlan {
        let threads = std::thread::available_parallelism().map_or(1, std::num::NonZeroUsize::get);
        let mut plan = ParticlePlan::default();
        plan.settings.threads = threads;
        plan.settings.seed = self.seed.unwrap_or(0);
        plan.settings.particles = self
            .particles
            .map_or(plan.settings.particles, |particles| particles as usize);
        plan.settings.density = match self.density {
            Some(DensityChoice::Optimal) | None => ImportanceDensity::Optimal,
            Some(DensityChoice::Prior) => ImportanceDensity::Prior,
        };
        plan.settings.kernel = self.kernel.unwrap_or(1.0);
        plan.drift_per_root_s = self.drift.unwrap_or(plan.drift_per_root_s);
        plan.warm_up_s = self.warm_up.unwrap_or(plan.warm_up_s);
        plan
    }
}

#[derive(Debug, Args)]
pub struct BaselineArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Recording of the undamaged structure; may be repeated.
    ///
    /// Several recordings show the scatter from record to record.
    #[arg(long, required = true)]
    pub record: Vec<PathBuf>,
    /// Time at the start of each recording to leave out while the filter converges (s).
    #[arg(long, default_value_t = 10.0, value_name = "SECONDS", value_parser = not_negative, allow_negative_numbers = true)]
    pub skip: f64,
    /// Standard deviation of each parameter between records, as a ratio to nominal [default:
    /// estimated from the recordings].
    ///
    /// A single recording contains no information about this scatter.
    #[arg(long, value_name = "RATIO", value_parser = not_negative, allow_negative_numbers = true)]
    pub between_std: Option<f64>,
    /// Output file for the baseline values.
    #[arg(long, value_name = "BASELINE.json")]
    pub output: PathBuf,
}

#[derive(Debug, Args)]
pub struct CheckArguments {
    /// Structure file.
    #[arg(value_name = "STRUCTURE.toml")]
    pub structure: PathBuf,
    /// Length of data for which to report standard deviations (s).
    #[arg(long, default_value_t = 60.0, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub after: f64,
    /// Compare the sensors with each other in this recording instead of checking the design; may be
    /// repeated.
    #[arg(long, value_name = "RECORD", group = "data", conflicts_with = "after")]
    pub record: Vec<PathBuf>,
    /// Compare the sensors with each other in SECONDS of live data instead.
    ///
    /// `spandrel run` or `spandrel ingest` must run, and the sensors must deliver.
    #[arg(long, value_name = "SECONDS", value_parser = seconds, group = "data", conflicts_with_all = ["after", "record"])]
    pub live: Option<f64>,
    /// Baseline file with the behaviour of the sound sensors.
    ///
    /// With it, the comparison finds smaller faults, and exchanged channels.
    #[arg(long, value_name = "BASELINE.json", requires = "data")]
    pub baseline: Option<PathBuf>,
    /// Print one JSON object instead of text.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub bus: BusArguments,
}

#[derive(Debug, Args)]
pub struct ValidateArguments {
    /// Cases, or the first part of their names such as `ekf` [default: all].
    #[arg(value_name = "CASE")]
    pub cases: Vec<String>,
    /// List the cases and exit.
    #[arg(long)]
    pub list: bool,
    /// Use shortened records and the corresponding limits.
    #[arg(long)]
    pub quick: bool,
    /// Run each case with this seed; may be repeated [default: 1].
    #[arg(long, value_name = "N", conflicts_with = "seeds")]
    pub seed: Vec<u64>,
    /// Run each case with a range of seeds, including both ends.
    ///
    /// 4..8 means 4, 5, 6, 7, 8. A single number N means 1..N.
    #[arg(long, value_name = "FIRST..LAST")]
    pub seeds: Option<Seeds>,
    /// Read the records of real structures below DIR. Cases that need them are otherwise skipped.
    ///
    /// Without CASE, identify these records and print the results, then run only the cases that
    /// need them.
    #[arg(long, value_name = "DIR", conflicts_with = "list")]
    pub records: Option<PathBuf>,

    /// Identify the records again with one faulty sensor each, which takes some minutes.
    #[arg(long, requires = "records")]
    #[arg(conflicts_with_all = ["cases", "quick", "seed", "seeds", "report"])]
    pub faulty_sensors: bool,
    /// Number of concurrent cases [default: number of cores].
    #[arg(long, value_name = "N")]
    pub jobs: Option<usize>,
    /// Print one JSON object per line and figure.
    #[arg(long)]
    pub json: bool,
    /// Write figures.md and index.html with diagrams to DIR.
    ///
    /// DIR/outcomes stores the outcomes. A stopped run resumes from them, and a run of some cases
    /// keeps the others on the page.
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
}
