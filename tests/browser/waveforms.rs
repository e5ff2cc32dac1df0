//! Waveforms and spectra of the sensors.

use super::{browser, demo, example, run_in, tall_building, tool};

#[tokio::test(flavor = "multi_thread")]
async fn waveforms_and_spectra_of_the_sensors_are_shown() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&["--duration", "600"]);
    browser.resize(1280, 1400).await;
    browser
        .open(&format!("{}#/structure/demo/sensors", demo.page))
        .await;
    let readout = |plot: &str| {
        format!("document.querySelector('#plot-{plot}-floor-2 .readout')?.textContent ?? ''")
    };
    browser
        .wait(
            "the waveform",
            &format!(
                "document.querySelector('#plot-waveform-floor-2 canvas') && / · \
                 −[\\d.·⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+ to −?[\\d.·⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+ m\\/s²$/.test({})",
                readout("waveform")
            ),
        )
        .await;
    let cell = |column: usize| {
        format!(
            "[...document.querySelectorAll('table.levels tbody tr')].find((row) => \
             row.children[0].textContent === 'floor-2')?.children[{column}].textContent"
        )
    };
    browser
        .wait("the rate", &format!("{} === '100'", cell(2)))
        .await;
    browser
        .wait(
            "the RMS",
            &format!("/^[\\d.·⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+ m\\/s²$/.test({})", cell(4)),
        )
        .await;
    // The waveform goes on without a reload.
    let before = browser.evaluate(&readout("waveform")).await;
    browser
        .wait(
            "a later second",
            &format!(
                "{now}.slice(0, 10) > {before}.slice(0, 10)",
                now = readout("waveform")
            ),
        )
        .await;
    // A plot is drawn when it is in the window.
    browser
        .wait(
            "the plot of the spectrum",
            "(document.querySelector('#plot-spectrum-floor-2')?.scrollIntoView(), \
             document.querySelector('#plot-spectrum-floor-2 canvas'))",
        )
        .await;
    browser
        .wait(
            "the spectrum",
            &format!(
                "/^[\\d.]+ Hz · [\\d.·⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+ \\(m\\/s²\\)²\\/Hz · mean of \\d+ windows? of \
                 20.48 s$/.test({})",
                readout("spectrum")
            ),
        )
        .await;
    let spectrogram = "document.querySelector('#plot-spectrogram-floor-2 canvas')";
    browser.wait("the spectrogram", spectrogram).await;
    browser
        .wait(
            "the highest density",
            &format!(
                "/ · highest density at [\\d.]+ Hz: \
                 [\\d.·⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+ \\(m\\/s²\\)²\\/Hz$/.test({})",
                readout("spectrogram")
            ),
        )
        .await;
    // High densities are green and yellow, which nothing else in the plot is.
    let colours = format!(
        "(() => {{ const canvas = {spectrogram}; \
           const {{ data }} = canvas.getContext('2d').getImageData(0, 0, canvas.width, \
           canvas.height); let green = 0; \
           for (let at = 0; at < data.length; at += 4) green += data[at + 1] > 150 && data[at + \
           1] > data[at] + 60 && data[at + 1] > data[at + 2] + 40; return green > 20; }})()"
    );
    browser.wait("the colours of densities", &colours).await;
    // Regression test: the first spectra were a strip at the right end of an empty plot. The plot
    // reaches from its axis to the right end of the canvas.
    let covered = format!(
        "(() => {{ const canvas = {spectrogram}; \
           const row = Math.round(0.4 * canvas.height); \
           const {{ data }} = canvas.getContext('2d').getImageData(0, row, canvas.width, 1); \
           let opaque = 0; \
           for (let at = 3; at < data.length; at += 4) opaque += data[at] === 255; \
           return opaque > 0.7 * canvas.width; }})()"
    );
    browser.reload().await;
    browser
        .wait(
            "the first spectrum after a reload",
            &format!(
                "(document.querySelector('#plot-spectrogram-floor-2')?.scrollIntoView(), {colours})"
            ),
        )
        .await;
    assert_eq!(browser.evaluate(&covered).await, true, "a strip");
    for scheme in ["light", "dark"] {
        browser.prefer(scheme).await;
        browser.screenshot(&format!("waveforms-{scheme}")).await;
    }
    browser
        .evaluate("document.querySelector('#group-waveforms input[type=checkbox]').click()")
        .await;
    browser
        .wait("its own scale", "location.hash.includes('scale=own')")
        .await;
    browser.resize(390, 844).await;
    browser
        .evaluate("document.getElementById('group-waveforms').scrollIntoView()")
        .await;
    let wide = "document.documentElement.scrollWidth";
    assert_eq!(browser.evaluate(wide).await, 390);
    browser.screenshot("waveforms-phone").await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Waveforms are the largest part of the data, and few views show them.
#[tokio::test(flavor = "multi_thread")]
async fn waveforms_are_sent_only_on_request() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&["--duration", "600"]);
    browser.open(&demo.page).await;
    let sent = |wish: bool| {
        format!(
            "(async () => {{
                const {{ Connection }} = await import('/connection.js');
                const connection = new Connection();
                const seen = new Set();
                connection.on('points', ({{ series }}) => Object.keys(series).forEach((name) => \
                seen.add(name.split('/')[0])));
                connection.want({wish});
                connection.listen('demo');
                await new Promise((done) => setTimeout(done, 3000));
                connection.listen(null);
                return ['parameter', 'waveform'].map((kind) => seen.has(kind)).join();
            }})()"
        )
    };
    let shown = "[...document.querySelectorAll('.structures')].length > 0";
    browser.wait("the structures", shown).await;
    assert_eq!(browser.evaluate(&sent(false)).await, "true,false");
    assert_eq!(browser.evaluate(&sent(true)).await, "true,true");
}

/// A spectrum that arrives twice is shown once, and a new run of measurement begins anew.
#[tokio::test(flavor = "multi_thread")]
async fn spectra_over_time_are_collected_once() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.open(&demo.page).await;
    browser
        .wait("the page", "document.querySelector('.structure-card')")
        .await;
    let times = |added: &str| {
        format!(
            "import('/spectrogram.js').then(({{ SpectrumHistory }}) => {{
                const history = new SpectrumHistory('demo', null);
                for (const time of {added}) history.add('floor-1', time, [1, 2], [0.5, null]);
                const of = history.columns('floor-1').spectra.map(({{ time_s }}) => time_s);
                return [of[0], of.at(-1), of.length];
            }})"
        )
    };
    let found = browser.evaluate(&times("[10, 20, 20, 30]")).await;
    assert_eq!(found, serde_json::json!([10, 30, 3]));
    let found = browser.evaluate(&times("[10, 20, 5, 15]")).await;
    assert_eq!(found, serde_json::json!([5, 15, 2]));
    let many = "Array.from({ length: 500 }, (_, index) => index)";
    let found = browser.evaluate(&times(many)).await;
    assert_eq!(found, serde_json::json!([320, 499, 180]));
}

/// Regression test: 41 channels took a page of 22,648 px.
#[tokio::test(flavor = "multi_thread")]
async fn forty_sensors_have_small_waveforms_with_details_of_one() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tall.toml");
    std::fs::write(&file, tall_building()).unwrap();
    let demo = demo(&["--structure", file.to_str().unwrap(), "--duration", "60"]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!("{}#/structure/tall/sensors", demo.page))
        .await;
    browser
        .wait(
            "drawn waveforms with their scale and figures",
            "/^Common scale: −.+ m\\/s²\\. From left to \
             right/.test(document.getElementById('waveform-scale')?.textContent) && \
             document.querySelectorAll('.small-sensor').length === 41 && \
             [...document.querySelectorAll('.small-sensor .figures')].every((one) => /^25 Hz · RMS \
             .+ · Peak .+ m\\/s²/.test(one.textContent))",
        )
        .await;
    // Both ends of a short range can be in one minute.
    let ends = "/From left to right: (.+:\\d\\d:\\d\\d) UTC to (.+:\\d\\d:\\d\\d) UTC\\./\
                .exec(document.getElementById('waveform-scale').textContent)?.slice(1)";
    let ends = browser.evaluate(ends).await;
    assert!(ends[0].is_string() && ends[0] != ends[1], "{ends}");
    let height = "document.documentElement.scrollHeight";
    let height = browser.evaluate(height).await.as_u64().unwrap();
    assert!(height < 3_500, "{height} px");
    browser.screenshot("forty-sensors").await;
    browser
        .evaluate("document.querySelector('[data-channel=acceleration-7].small-sensor').click()")
        .await;
    assert_eq!(
        browser.evaluate("location.hash").await,
        "#/structure/tall/sensors?sensor=acceleration-7"
    );
    let large = "/ to .+ m\\/s²$/.test(document.querySelector('#plot-waveform-acceleration-7 \
                 .readout')?.textContent)";
    browser.wait("the large waveform", large).await;
    browser
        .wait(
            "its spectrum",
            "(document.querySelector('#plot-spectrum-acceleration-7')?.scrollIntoView(), \
             document.querySelector('#plot-spectrum-acceleration-7 canvas'))",
        )
        .await;
    browser.reload().await;
    browser.wait("the same after a reload", large).await;
    browser.screenshot("forty-sensors-detail").await;
    browser.resize(390, 844).await;
    let width = "document.documentElement.scrollWidth";
    assert_eq!(browser.evaluate(width).await, 390);
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// The page had neither waveforms nor spectra of nodes with their own filters.
#[tokio::test(flavor = "multi_thread")]
async fn waveforms_of_nodes_with_their_own_filters_are_shown() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&["--distributed"]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!(
            "{}#/structure/demo-distributed/sensors",
            demo.page
        ))
        .await;
    browser
        .wait(
            "the waveforms and figures of all channels",
            "document.querySelectorAll('.small-sensor').length === 32 && \
             [...document.querySelectorAll('.small-sensor .figures')].some((one) => /^50 Hz · RMS \
             .+ · Peak .+ m\\/s²/.test(one.textContent))",
        )
        .await;
    browser
        .evaluate("document.querySelector('[data-channel=acceleration-1].small-sensor').click()")
        .await;
    let large = "/ to .+ m\\/s²$/.test(document.querySelector('#plot-waveform-acceleration-1 \
                 .readout')?.textContent)";
    browser.wait("the large waveform", large).await;
    browser
        .wait(
            "its spectrum",
            "(document.querySelector('#plot-spectrum-acceleration-1')?.scrollIntoView(), \
             document.querySelector('#plot-spectrum-acceleration-1 canvas'))",
        )
        .await;
    browser.screenshot("waveforms-of-nodes").await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
    // The samples of the past stay at the nodes, and the page says so.
    browser
        .evaluate(
            "location.hash = '#/structure/demo-distributed/sensors?from=1600000000&to=1600000020'",
        )
        .await;
    browser
        .wait(
            "the reason",
            "document.querySelector('#group-waveforms \
             .told:not([hidden])')?.textContent.includes('the samples stay at the nodes')",
        )
        .await;
}

/// Regression test: the page did not read the samples of nodes with their own filters, although
/// ingest had recorded them.
#[tokio::test(flavor = "multi_thread")]
async fn recorded_samples_of_nodes_with_their_own_filters_are_shown() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let structure = example("demo-distributed.toml");
    let record = folder.path().join("record.csv");
    let record = record.to_str().unwrap();
    tool(&[
        "simulate",
        &structure,
        "--record",
        record,
        "--duration",
        "5",
    ]);
    let (run, endpoint) = run_in(folder.path(), &structure);
    tool(&[
        "replay",
        record,
        "--structure",
        &structure,
        "--speed",
        "max",
        "--connect",
        &endpoint,
    ]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!(
            "{}#/structure/demo-distributed/settings",
            run.page
        ))
        .await;
    // The page reads the samples of a range only once.
    browser
        .wait(
            "all frames",
            "[...document.querySelectorAll('.services tbody tr')].some(({ children: [service, , , \
             done] }) => service.textContent === 'ingest' && done.textContent === '250')",
        )
        .await;
    browser
        .evaluate(
            "location.hash = \
             '#/structure/demo-distributed/sensors?from=1&to=4&sensor=acceleration-1'",
        )
        .await;
    // The least and the largest value of one sample are equal. Those of a tenth of a second, which
    // the server keeps, differ.
    browser
        .wait(
            "each sample up to the end of the range",
            "/^4\\.00 s · (\\S+) to \\1 m\\/s²$/.test(document.querySelector(\
             '#plot-waveform-acceleration-1 .readout')?.textContent)",
        )
        .await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}

/// Regression test: the waveforms of an event were lost with a restart, and had ten points a second.
#[tokio::test(flavor = "multi_thread")]
async fn waveforms_of_an_event_are_those_of_the_recording() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!("{}#/structure/demo/events", demo.page))
        .await;
    browser
        .wait(
            "the alarm and the end of the demo",
            "document.querySelector('.events tr[data-level=alarm] .samples-of') && \
             document.body.innerText.includes('record has ended')",
        )
        .await;
    let link = "document.querySelector('.events tr[data-level=alarm] .samples-of a').hash";
    let hash = browser.evaluate(link).await;
    let hash = hash.as_str().unwrap();
    assert!(hash.starts_with("#/structure/demo/sensors?from="), "{hash}");
    browser.evaluate(&format!("location.hash = '{hash}'")).await;
    // At 100 samples a second, two points are nearer than a tenth of a second.
    let steps = "import('/waveforms.js').then(({ envelope }) => envelope([0, 1, 2, 3], [5, NaN, 7, \
                 6], { from_s: 0, to_s: 4, count: 2 }))";
    assert_eq!(
        browser.evaluate(steps).await,
        serde_json::json!([[0, 2], [5, 6], [5, 7]])
    );
    // Times of an axis that are in one minute, or in one second, differ.
    let ticks = "import('/plot.js').then(({ timeTicks }) => [20, 0.5].map((step) => timeTicks([0, \
                 step].map((time) => 1600000020 + time), step)))";
    assert_eq!(
        browser.evaluate(ticks).await,
        serde_json::json!([
            ["12:27:00\n2020-09-13", "12:27:20"],
            ["12:27:00.000\n2020-09-13", "12:27:00.500"]
        ])
    );
    let asked = "performance.getEntriesByType('resource').filter(({ name }) => \
                 name.includes('/samples?')).length";
    let top = "document.querySelector('#group-waveforms').getBoundingClientRect().top";
    browser
        .wait(
            "the waveforms in the window",
            &format!("{top} > 0 && {top} < innerHeight / 2"),
        )
        .await;
    // A plot outside the window is not drawn.
    let plot = "document.querySelector('#plot-waveform-floor-2')";
    let readout = format!("({plot}?.querySelector('.readout').textContent ?? '')");
    browser
        .wait(
            "the samples, read once for all sensors",
            &format!(
                "({plot}?.scrollIntoView(), / to .+ m\\/s²$/.test({readout}) && {asked} === 1)"
            ),
        )
        .await;
    browser.screenshot("waveforms-of-an-event").await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
    // A time without samples says so.
    browser
        .evaluate("location.hash = '#/structure/demo/sensors?from=1600000000&to=1600000020'")
        .await;
    browser
        .wait(
            "the reason",
            "document.querySelector('#group-waveforms \
             .told:not([hidden])')?.textContent.includes('the recording of ingest does not \
             contain it')",
        )
        .await;
}
