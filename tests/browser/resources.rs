//! The resources that the page needs over a long time.

use super::{Browser, Program, browser, free_address};

/// Resource use of the page at one moment.
#[derive(Debug, Clone, Copy)]
struct Cost {
    /// Memory of the scripts after garbage collection (MB).
    heap_mb: f64,
    /// Number of elements of the document.
    nodes: f64,
    /// Processor time of the main thread since the start (s).
    worked_s: f64,
}

async fn cost(browser: &mut Browser) -> Cost {
    browser
        .call("HeapProfiler.collectGarbage", serde_json::json!({}))
        .await;
    let metrics = browser
        .call("Performance.getMetrics", serde_json::json!({}))
        .await;
    let metric = |name: &str| {
        let metrics = metrics["metrics"].as_array().unwrap();
        metrics
            .iter()
            .find(|metric| metric["name"] == name)
            .unwrap()["value"]
            .as_f64()
            .unwrap()
    };
    Cost {
        heap_mb: metric("JSHeapUsedSize") / 1e6,
        nodes: metric("Nodes"),
        worked_s: metric("ThreadTime"),
    }
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes 20 minutes"]
async fn the_page_needs_no_more_resources_after_twenty_minutes_at_24_times_the_display_rate() {
    const MINUTES: usize = 20;
    // Until this minute, the span of ten minutes and its plots fill up.
    const SETTLED: usize = 4;
    let Some(mut browser) = browser().await else {
        return;
    };
    let endpoint = format!("tcp/{}", free_address());
    let arguments = [
        "demo",
        "--speed",
        "24",
        "--duration",
        "32000",
        "--http",
        "127.0.0.1:0",
        "--listen",
        &endpoint,
    ];
    let demo = Program::start(&arguments);
    browser.resize(1280, 900).await;
    browser
        .call("Performance.enable", serde_json::json!({}))
        .await;
    browser
        .open(&format!("{}#/structure/demo/parameters", demo.page))
        .await;
    browser
        .wait(
            "the first plot",
            "document.querySelector('#plot-parameter-storey-1 canvas')",
        )
        .await;
    browser
        .evaluate("document.querySelector('.ranges').scrollIntoView()")
        .await;
    let mut costs = vec![cost(&mut browser).await];
    for minute in 1..=MINUTES {
        // This test measures time, so it must sleep.
        tokio::time::sleep(std::time::Duration::from_secs(60)).await;
        costs.push(cost(&mut browser).await);
        let (before, now) = (costs[minute - 1], costs[minute]);
        let share = 100.0 * (now.worked_s - before.worked_s) / 60.0;
        eprintln!(
            "{minute:2} min  heap {:6.2} MB  nodes {:5.0}  main thread {share:4.1} %",
            now.heap_mb, now.nodes
        );
    }
    let mean = |range: std::ops::Range<usize>, of: fn(&Cost) -> f64| {
        costs[range.clone()].iter().map(of).sum::<f64>() / range.len() as f64
    };
    let (early, late) = (SETTLED..SETTLED + 4, MINUTES - 3..MINUTES + 1);
    let [heap_early, heap_late] =
        [early.clone(), late.clone()].map(|range| mean(range, |cost| cost.heap_mb));
    // A leak of one point per series and message would be about 100 MB.
    assert!(
        heap_late < heap_early + 3.0,
        "heap from {heap_early:.1} to {heap_late:.1} MB"
    );
    let nodes = (costs[SETTLED].nodes, costs[MINUTES].nodes);
    assert!(
        nodes.1 < 1.2 * nodes.0,
        "elements from {} to {}",
        nodes.0,
        nodes.1
    );
    let worked =
        |range: std::ops::Range<usize>| costs[range.end - 1].worked_s - costs[range.start].worked_s;
    let (work_early, work_late) = (worked(early), worked(late));
    assert!(
        work_late < 1.5 * work_early,
        "work of the main thread from {work_early:.1} to {work_late:.1} s in 3 minutes"
    );
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}
