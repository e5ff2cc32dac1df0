//! `spandrel replay`: publishes a recording on the bus as its sensor nodes would.

use super::{counted, print, progress};
use crate::cli::ReplayArguments;
use crate::error::AppError;
use crate::record_source;
use crate::role_check::{Need, Work, check};
use crate::services::{block_on, interrupted};
use crate::settings::Settings;
use spandrel_bus::Bus;
use spandrel_sensor::{
    Clocks, NodePlan, Origin, SensorError, SensorService, SensorSettings, open_record,
    recorded_rows,
};
use spandrel_service::Clock;
use spandrel_structure::Structure;

/// Replays until the end of the recording, or until Ctrl-C.
///
/// # Errors
/// Returns an error if a file is not valid, or if the bus cannot be joined.
pub fn run(arguments: ReplayArguments) -> Result<(), AppError> {
    let structure = Structure::read(&arguments.structure)?;
    let recording = open_record(&structure, &arguments.record)?;
    let settings = Settings::load(&arguments.bus)?;
    let keys = settings.bus.keys(structure.name())?;
    let bar = progress::bar("replaying", record_source::expected_rows(&arguments.record));
    block_on(async {
        let bus = Bus::open(&settings.bus).await?;
        let nodes = structure.nodes().iter().map(|node| node.name()).collect();
        let work = Work {
            subcommand: "replay",
            needs: &[Need::PUT_SAMPLES],
            structures: vec![structure.name()],
            nodes,
        };
        check(&bus, &settings.bus, &work).await?;
        let sensor = SensorSettings {
            origin: Origin::Recorded,
            speed: arguments.speed.into(),
            epoch: Clock::of_machine().epoch(),
            wait_for: super::simulate::readers(&structure),
            resume: arguments.resume,
        };
        let nodes = NodePlan::of(&structure, Clocks::Right).map_err(SensorError::from)?;
        let service =
            SensorService::start(nodes, structure.sampling_rate_hz(), &bus, keys, sensor).await?;
        let shown = bar.clone();
        let rows = recorded_rows(recording, 0).inspect(move |_| shown.inc(1));
        let replayed = service.run(rows, interrupted()).await;
        bar.finish_and_clear();
        bus.close().await?;
        let frames = counted(replayed? as usize, "frame", "frames");
        print(&format!(
            "{}: {frames} of {} sent\n",
            arguments.record.display(),
            structure.name()
        ))
    })
}
