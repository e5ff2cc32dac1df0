/* A sensor node for Spandrel with one channel at 100 Hz, which publishes JSON over zenoh-pico.
 *
 *     spandrel-sensor ENDPOINT ROOT/STRUCTURE NODE BLOCKS
 *     spandrel-sensor tcp/127.0.0.1:7447 spandrel/demo floor-1 20
 *
 * docs/topics.md describes the messages. Replace `read_instrument` by your own function.
 */
#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <zenoh-pico.h>

enum {
    RATE_HZ = 100,
    SAMPLES_PER_BLOCK = 50, /* 0.5 s: people see this delay, and the network has few messages */
    KEY_BYTES = 300,        /* three names of 64 characters, and the chunks between them */
    BLOCK_BYTES = 4096,     /* 50 numbers of at most 25 characters, and the other fields */
    WAIT_FOR_READER_MS = 5000,
};

static const int64_t STEP_NS = 1000000000 / RATE_HZ;

/* Position of a node in its stream. */
struct stream {
    const char* node;
    uint64_t epoch;    /* rises at each start */
    uint64_t sequence; /* number of the next sample */
    int64_t start_ns;  /* time of sample 0, ns since the Unix epoch, UTC */
};

/* A bounded text. `fits` becomes false instead of an overflow. */
struct text {
    char bytes[BLOCK_BYTES];
    size_t length;
    bool fits;
};

static void append(struct text* text, const char* format, ...) {
    size_t room = sizeof text->bytes - text->length;
    va_list arguments;
    va_start(arguments, format);
    int length = vsnprintf(text->bytes + text->length, room, format, arguments);
    va_end(arguments);
    if (length < 0 || (size_t)length >= room) {
        text->fits = false;
        return;
    }
    text->length += (size_t)length;
}

/* Writes a block of samples. 17 digits identify every number exactly. A missing sample is null. */
static void write_block(struct text* text, const struct stream* stream, const double* samples,
                        size_t count, bool ended) {
    text->length = 0;
    text->fits = true;
    append(text, "{\"source\":\"%s\",\"epoch\":%" PRIu64 ",\"sequence\":%" PRIu64, stream->node,
           stream->epoch, stream->sequence);
    append(text,
           ",\"time_ns\":%" PRId64
           ",\"sampling_rate_hz\":%d,\"channels\":1,\"state\":\"%s\",\"samples\":[",
           stream->start_ns + (int64_t)stream->sequence * STEP_NS, RATE_HZ,
           ended ? "ended" : "running");
    for (size_t index = 0; index < count; index++) {
        const char* comma = index == 0 ? "" : ",";
        if (isfinite(samples[index])) {
            append(text, "%s%.17g", comma, samples[index]);
        } else {
            append(text, "%snull", comma);
        }
    }
    append(text, "]}");
}

/* Waits for the next block of the instrument. This one repeats a ramp, whose tenth sample is
 * missing. */
static void read_instrument(uint64_t sequence, double* samples) {
    z_sleep_ms(1000 * SAMPLES_PER_BLOCK / RATE_HZ);
    for (uint64_t index = 0; index < SAMPLES_PER_BLOCK; index++) {
        uint64_t step = (sequence + index) % 100;
        samples[index] = step == 10 ? NAN : 0.01 * (double)step;
    }
}

static int publish(const z_loaned_publisher_t* publisher, const struct text* text) {
    if (!text->fits) {
        fprintf(stderr, "a block exceeds %d bytes\n", BLOCK_BYTES);
        return -1;
    }
    z_owned_bytes_t payload;
    if (z_bytes_copy_from_buf(&payload, (const uint8_t*)text->bytes, text->length) < 0) {
        fprintf(stderr, "no memory for a block\n");
        return -1;
    }
    if (z_publisher_put(publisher, z_move(payload), NULL) < 0) {
        /* The number of the next block shows the loss to ingest. */
        fprintf(stderr, "a block was not sent\n");
    }
    return 0;
}

/* zenoh-pico sends nothing before it knows a reader. */
static void wait_for_reader(const z_loaned_publisher_t* publisher) {
    z_matching_status_t status = {false};
    for (int waited = 0; waited < WAIT_FOR_READER_MS; waited += 10) {
        if (z_publisher_get_matching_status(publisher, &status) == 0 && status.matching) {
            return;
        }
        z_sleep_ms(10);
    }
    fprintf(stderr, "no ingest reads these samples yet\n");
}

static int run(const z_loaned_session_t* session, const char* prefix, const char* node,
               uint64_t blocks) {
    char samples_key[KEY_BYTES], live_key[KEY_BYTES];
    int lengths[] = {
        snprintf(samples_key, sizeof samples_key, "%s/sensor/%s/samples", prefix, node),
        snprintf(live_key, sizeof live_key, "%s/live/sensor/%s", prefix, node),
    };
    z_view_keyexpr_t samples_expression, live_expression;
    size_t allowed = strspn(node, "abcdefghijklmnopqrstuvwxyz0123456789-");
    if (allowed == 0 || node[allowed] != '\0') {
        fprintf(stderr, "node is \"%s\", must have only the characters a-z, 0-9 and -\n", node);
        return 2;
    }
    if (lengths[0] >= KEY_BYTES || lengths[1] >= KEY_BYTES ||
        z_view_keyexpr_from_str(&samples_expression, samples_key) < 0 ||
        z_view_keyexpr_from_str(&live_expression, live_key) < 0) {
        fprintf(stderr, "%s and %s do not form a key\n", prefix, node);
        return 2;
    }
    z_publisher_options_t options;
    z_publisher_options_default(&options);
    z_owned_encoding_t encoding;
    z_owned_publisher_t publisher;
    z_owned_liveliness_token_t token;
    if (z_encoding_from_str(&encoding, "application/json;spandrel.samples.v1") < 0) {
        fprintf(stderr, "no memory for the encoding\n");
        return 1;
    }
    options.encoding = z_move(encoding);
    if (z_declare_publisher(session, &publisher, z_loan(samples_expression), &options) < 0) {
        fprintf(stderr, "cannot publish on %s\n", samples_key);
        return 1;
    }
    wait_for_reader(z_loan(publisher));
    /* Frames stop waiting for the node when the token disappears. */
    if (z_liveliness_declare_token(session, &token, z_loan(live_expression), NULL) < 0) {
        fprintf(stderr, "cannot announce %s\n", live_key);
        z_drop(z_move(publisher));
        return 1;
    }
    struct timespec now;
    timespec_get(&now, TIME_UTC);
    int64_t start_ns = (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
    struct stream stream = {
        .node = node, .epoch = (uint64_t)start_ns, .sequence = 0, .start_ns = start_ns};
    static struct text text;
    double samples[SAMPLES_PER_BLOCK];
    int result = 0;
    for (uint64_t block = 0; block < blocks && result == 0; block++) {
        read_instrument(stream.sequence, samples);
        write_block(&text, &stream, samples, SAMPLES_PER_BLOCK, false);
        result = publish(z_loan(publisher), &text);
        stream.sequence += SAMPLES_PER_BLOCK;
    }
    write_block(&text, &stream, NULL, 0, true);
    if (publish(z_loan(publisher), &text) < 0) {
        result = -1;
    }
    z_sleep_ms(100); /* closing the session discards blocks that are not sent yet */
    z_drop(z_move(token));
    z_drop(z_move(publisher));
    return result == 0 ? 0 : 1;
}

int main(int argc, char** argv) {
    char* end = NULL;
    errno = 0;
    unsigned long blocks = argc == 5 ? strtoul(argv[4], &end, 10) : 0;
    if (argc != 5 || errno != 0 || end == argv[4] || *end != '\0') {
        fprintf(stderr, "usage: spandrel-sensor ENDPOINT ROOT/STRUCTURE NODE BLOCKS\n");
        return 2;
    }
    z_owned_config_t config;
    z_owned_session_t session;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, argv[1]);
    if (z_open(&session, z_move(config), NULL) < 0) {
        fprintf(stderr, "no connection to %s; start spandrel run there\n", argv[1]);
        return 1;
    }
    int result = run(z_loan(session), argv[2], argv[3], blocks);
    z_drop(z_move(session));
    return result;
}
