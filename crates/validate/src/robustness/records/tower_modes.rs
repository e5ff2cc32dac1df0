//! The natural frequencies of the test tower, which update the stiffnesses of a shear chain. What
//! shakes the tower is not used.
//!
//! Each record is judged against the other two, with one epoch per record. The second half of each
//! record is also judged against its first half, where the scatter between records has no effect. A
//! loss of one storey is added by the calibrated model: its change of each frequency and shape is
//! added to the identified ones, whose residuals stay.

use super::course::Recorded;
use super::{RecordsError, Row, replaced};
use nalgebra::{DMatrix, DVector};
use spandrel_bus::{ModeDisplay, Name, ShapeValue};
use spandrel_modal::{PartModel, SeenMode, StiffnessChange, UpdateReference};
use spandrel_modes::{DeclaredModes, EpochOver, ModesError, Stiffnesses};
use spandrel_structure::Structure;
use std::path::Path;

const FILE: &str = include_str!("tower-modes.toml");
const RECORDS: [&str; 3] = ["wn_01.dat", "wn_02.dat", "wn_03.dat"];
/// Added loss of one storey.
const LOSS: f64 = 0.15;
/// Losses whose probabilities are stated; the first is that of the rule.
const STATED: [f64; 3] = [0.1, 0.05, 0.0];
/// Credibility of the rule.
const CREDIBILITY: f64 = 0.99;

/// Returns the rows of the tower.
pub(super) fn rows(data: &Path) -> Result<Vec<Row>, RecordsError> {
    let folder = data.join("unison-tower");
    if !folder.is_dir() {
        let why = format!("no records in {}", folder.display());
        return Ok(vec![Row::skipped("test tower: modes", "", why)]);
    }
    let Some(tower) = Tower::read(FILE)? else {
        return Ok(Vec::new()); // the file has modes that update stiffnesses
    };
    let records = tower.epochs(&folder, 1)?;
    let against_others = (0..records.len()).map(|number| Trial {
        record: RECORDS[number],
        commissioning: (0..records.len())
            .filter(|other| *other != number)
            .map(|other| &records[other][0])
            .collect(),
        judged: &records[number][0],
    });
    let mut rows = tower.judge("", &against_others.collect::<Vec<_>>())?;

    let halves = [
        ("epoch-s = 380", "epoch-s = 196"),
        ("commissioning-epochs = 2", "commissioning-epochs = 1"),
    ];
    let Some(tower) = Tower::read(&replaced(FILE, &halves)?)? else {
        return Ok(rows);
    };
    let records = tower.epochs(&folder, 2)?;
    let within = records.iter().zip(RECORDS).map(|(epochs, record)| Trial {
        record,
        commissioning: vec![&epochs[0]],
        judged: &epochs[1],
    });
    rows.extend(tower.judge(" (halves of a record)", &within.collect::<Vec<_>>())?);
    Ok(rows)
}

/// The declared modes after an epoch.
type Epoch = Vec<ModeDisplay>;

/// An epoch, and those that it is judged against.
struct Trial<'e> {
    record: &'static str,
    commissioning: Vec<&'e Epoch>,
    judged: &'e Epoch,
}

/// The tower with the settings of its epochs.
struct Tower {
    structure: Structure,
    stiffnesses: Stiffnesses,
}

impl Tower {
    /// Returns `None` if the file has no modes that update stiffnesses.
    fn read(file: &str) -> Result<Option<Self>, RecordsError> {
        let structure = Structure::parse(file, Path::new("tower-modes.toml"))?;
        let stiffnesses = Stiffnesses::new(&structure)?;
        Ok(stiffnesses.map(|stiffnesses| Self {
            structure,
            stiffnesses,
        }))
    }

    /// Returns the first `count` epochs of each record.
    fn epochs(&self, folder: &Path, count: usize) -> Result<Vec<Vec<Epoch>>, RecordsError> {
        let of_record = |name| modes(&self.structure, &folder.join(name), count);
        RECORDS.iter().map(of_record).collect()
    }

    /// Returns the rows of the sound epochs, and of the same with a loss of each storey.
    fn judge(&self, of: &str, trials: &[Trial<'_>]) -> Result<Vec<Row>, RecordsError> {
        let mut sound = Row::new(
            format!("test tower: stiffnesses from modes{of}"),
            "no alert at 10 %; the changes within their intervals",
        );
        let mut damaged = Row::new(
            format!("test tower: stiffnesses from modes{of}, one storey has lost 15 %"),
            "raised at 10 % for this storey in each record",
        );
        let (mut inside, mut all, mut false_alerts) = (0_u32, 0_u32, 0);
        let mut found = [0_u32; STATED.len()];
        let (mut nearest, mut wrong) = (0_u32, 0_u32);
        let raised = |change: &StiffnessChange, part: usize, loss: f64| {
            change.probability_of_loss(part, loss) >= CREDIBILITY
        };
        for trial in trials {
            let commissioning = trial.commissioning.iter();
            let commissioning: Vec<_> = commissioning.map(|epoch| self.seen(epoch)).collect();
            let judged = Judged {
                model: self.stiffnesses.model(),
                reference: UpdateReference::learn(
                    self.stiffnesses.model(),
                    self.stiffnesses.settings(),
                    &commissioning,
                )
                .map_err(ModesError::from)?,
            };
            let change = judged.change(&self.seen(trial.judged))?;
            sound.runs += 1;
            sound.seen += &format!("{}: ", trial.record);
            for part in 0..change.parts() {
                all += 1;
                inside += u32::from((0.025..0.975).contains(&change.cdf(part, 0.0)));
                let percent = |ln: f64| 100.0 * (ln.exp() - 1.0);
                sound.seen += &format!(
                    "{:+.1} [{:+.1}, {:+.1}] ",
                    percent(change.mean(part)),
                    percent(change.quantile(part, 0.025)),
                    percent(change.quantile(part, 0.975)),
                );
            }
            sound.seen += "%; ";
            false_alerts +=
                usize::from((0..change.parts()).any(|part| raised(&change, part, STATED[0])));
            damaged.seen += &format!("{}: ", trial.record);
            for storey in 0..change.parts() {
                let lossy = judged.with_loss(trial.judged, storey)?;
                let change = judged.change(&self.seen(&lossy))?;
                damaged.runs += 1;
                for (count, loss) in found.iter_mut().zip(STATED) {
                    *count += u32::from(raised(&change, storey, loss));
                }
                let others = (0..change.parts()).filter(|other| *other != storey);
                let is_largest = others
                    .clone()
                    .all(|other| change.mean(other) > change.mean(storey));
                nearest += u32::from(is_largest);
                wrong += u32::from(others.into_iter().any(|other| raised(&change, other, 0.0)));
                damaged.seen += &format!(
                    "{:.1} ± {:.1} ({:.3}) ",
                    100.0 * (1.0 - change.mean(storey).exp()),
                    100.0 * change.std(storey),
                    change.probability_of_loss(storey, STATED[0]),
                );
            }
            damaged.seen += "%; ";
        }
        sound.false_alerts = Some(false_alerts);
        sound.coverage = Some(f64::from(inside) / f64::from(all));
        sound.passed = Some(false_alerts == 0 && inside == all);
        let runs = damaged.runs;
        damaged.seen += &format!(
            "loss above 10, 5 and 0 % with a probability of 0.99 in {}, {} and {} of {runs}; the \
             largest estimated loss is that of the storey in {nearest}; another storey has lost \
             with 0.99 in {wrong}",
            found[0], found[1], found[2],
        );
        damaged.passed = Some(found.first().copied() == u32::try_from(runs).ok());
        Ok(vec![sound, damaged])
    }

    fn seen(&self, epoch: &[ModeDisplay]) -> Vec<Option<SeenMode>> {
        epoch
            .iter()
            .map(|mode| self.stiffnesses.seen(mode))
            .collect()
    }
}

/// A reference, and the model that it has calibrated.
struct Judged<'m> {
    model: &'m PartModel,
    reference: UpdateReference,
}

impl Judged<'_> {
    fn change(&self, epoch: &[Option<SeenMode>]) -> Result<StiffnessChange, RecordsError> {
        let change = self.reference.change(self.model, epoch);
        Ok(change.map_err(ModesError::from)?)
    }

    /// Adds the effect of a loss of one storey to the modes of an epoch.
    fn with_loss(
        &self,
        epoch: &[ModeDisplay],
        storey: usize,
    ) -> Result<Vec<ModeDisplay>, RecordsError> {
        let sound = self.reference.ln_stiffness.clone();
        let mut lossy = sound.clone();
        lossy[storey] += (1.0 - LOSS).ln();
        let at = |x: &DVector<f64>| self.model.modes(x).map_err(ModesError::from);
        let (before, after) = (at(&sound)?, at(&lossy)?);
        let pairs = epoch.iter().cloned().zip(self.reference.of_model());
        Ok(pairs
            .map(|(mut display, of_model)| {
                if let (Some(estimate), Some(mode)) = (&mut display.estimate, of_model) {
                    estimate.frequency_hz *= after.0[mode] / before.0[mode];
                    add_shape(&mut estimate.shape, &before.1, &after.1, mode);
                }
                display
            })
            .collect())
    }
}

/// Adds the change of a shape of the model to an identified one, at its scale.
fn add_shape(shape: &mut [ShapeValue], before: &DMatrix<f64>, after: &DMatrix<f64>, mode: usize) {
    let before = before.column(mode).normalize();
    let after = after.column(mode).normalize();
    let after = &after * after.dot(&before).signum();
    let real = DVector::from_iterator(shape.len(), shape.iter().map(|value| value.value[0]));
    let scale = real.norm() * real.dot(&before).signum();
    for (value, change) in shape.iter_mut().zip((after - before).iter()) {
        value.value[0] += scale * change;
    }
}

/// Returns the declared modes after each of the first `count` epochs of a record.
fn modes(structure: &Structure, path: &Path, count: usize) -> Result<Vec<Epoch>, RecordsError> {
    let too_short = || RecordsError::NothingLearnt {
        record: path.display().to_string(),
    };
    let plan = structure.modal().ok_or_else(too_short)?;
    let mut stream = plan.stream().map_err(ModesError::from)?;
    let mut declared = DeclaredModes::new(&Name::new(structure.name())?, plan)?;
    let mut frame = vec![f64::NAN; plan.channels.len()];
    let mut epochs = Vec::new();
    for row in Recorded::read(structure, path)?.rows {
        for (value, channel) in frame.iter_mut().zip(&plan.channels) {
            *value = row.values.get(*channel).copied().unwrap_or(f64::NAN);
        }
        let Some(epoch) = stream.push(&frame).map_err(ModesError::from)? else {
            continue;
        };
        let found = epoch.identify().map_err(ModesError::from)?;
        let over = EpochOver {
            time_ns: 0,
            epoch: &epoch,
            found: &found,
        };
        declared.handle(over, &mut Vec::new());
        epochs.push(declared.displays().to_vec());
        if epochs.len() == count {
            return Ok(epochs);
        }
    }
    Err(too_short())
}
