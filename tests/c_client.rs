//! The sensor node in C, compiled with zenoh-pico, against a running ingest.
//!
//! The test needs CMake, a C compiler, and the folder of zenoh-pico in `ZENOH_PICO`: its sources,
//! or the folder in which it is installed.

use crate::support::{Process, Site, skip, two_storeys, within, zenoh_pico_or_skip};
use spandrel_bus::{Delivery, FrameBlock, Start, StreamSettings};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Blocks of 50 samples that the node publishes.
const BLOCKS: usize = 4;

/// Compiles the node. Returns its path, or skips the test.
fn compiled() -> Option<PathBuf> {
    let zenoh_pico = zenoh_pico_or_skip()?;
    let cmake = |arguments: &[&str]| Command::new("cmake").args(arguments).output();
    if cmake(&["--version"]).is_err() {
        skip("CMake is not installed");
        return None;
    }
    let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../clients/c");
    let build = Path::new(env!("CARGO_TARGET_TMPDIR")).join("c-client");
    let sources = sources.to_str().unwrap();
    let (folder, build_folder) = (
        format!("-DZENOH_PICO={}", zenoh_pico.display()),
        build.to_str().unwrap(),
    );
    for arguments in [
        &["-S", sources, "-B", build_folder, &folder][..],
        &["--build", build_folder, "--parallel", "2"],
    ] {
        let output = cmake(arguments).unwrap();
        let said = [output.stdout, output.stderr].concat();
        assert!(
            output.status.success(),
            "{}",
            String::from_utf8_lossy(&said)
        );
    }
    Some(build.join("spandrel-sensor"))
}

/// Returns the sample that the node publishes. `None` if it is missing.
fn published(index: usize) -> Option<f64> {
    let step = index % 100;
    (step != 10).then_some(0.01 * step as f64)
}

#[tokio::test(flavor = "multi_thread")]
async fn the_frames_contain_the_samples_of_the_node_in_c() {
    let Some(program) = compiled() else { return };
    let site = Site::with(&two_storeys("[ingest]\nlateness-s = 0.5\n"));
    let ingest = Process::start(&mut site.listening("ingest"));
    ingest.wait_for_log("ready structures=1");
    let (bus, keys) = (site.join().await, site.keys());
    let settings = StreamSettings::new(Start::Beginning);
    let frames = bus.follow::<FrameBlock>(keys.frames(), keys.recording(), settings);
    let frames = frames.await.unwrap();
    let mut node = Command::new(program);
    let prefix = format!("{}/house", keys.root());
    let node = node.args([site.endpoint(), &prefix, "floor-1", &BLOCKS.to_string()]);
    Process::start(node).wait().expect_code(0);
    let channels = site.structure().channels();
    let column = channels
        .map(|channel| channel.name().to_owned())
        .position(|name| name == "floor-1")
        .unwrap();
    let mut found = Vec::new();
    within("all frames", async {
        while found.len() < 50 * BLOCKS {
            match frames.deliveries().recv_async().await.unwrap() {
                Delivery::Block(block) => {
                    found.extend(block.iter().map(|(_, frame)| frame[column]));
                }
                Delivery::Gap(gap) => panic!("{gap:?}"),
            }
        }
    })
    .await;
    for (index, value) in found.into_iter().enumerate() {
        let value = (!value.is_nan()).then_some(value);
        assert_eq!(value, published(index), "sample {index}");
    }
    ingest.stop().expect_code(0);
}
