//! Prints the parameters of the demo as they are published. Run `spandrel demo` in another
//! terminal.

use spandrel_bus::{Bus, BusConfig, DEFAULT_ENDPOINT, Mode, ParameterDisplay};
use std::io::Write;

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let config = BusConfig {
        mode: Mode::Client,
        connect: vec![DEFAULT_ENDPOINT.into()],
        ..BusConfig::default()
    };
    let bus = Bus::open(&config).await?;
    let topic = config.keys("demo")?.all_parameters();
    let parameters = bus.subscribe::<ParameterDisplay>(topic, 256).await?;
    while let Ok((key, shown)) = parameters.messages().recv_async().await {
        writeln!(
            std::io::stdout(),
            "{key}: {:.3} ± {:.3}",
            shown.mean,
            shown.std
        )?;
    }
    Ok(())
}
