/* Telemetry of an RTC in C: a batch of frames and a status, written from docs/rtc.md.
 *
 * The bytes alone, as in docs/rtc/frames.* and status-minimal.msgpack:
 *     cc -std=c99 -Wall -Wextra telemetry.c -o telemetry && ./telemetry FOLDER
 * Sent with zenoh-c 1.x (https://github.com/eclipse-zenoh/zenoh-c):
 *     cc -std=c11 -DWITH_ZENOH telemetry.c -lzenohc -o telemetry && ./telemetry ENDPOINT SYSTEM
 *
 * The tests run the first, and compile the second against zenoh-c's declarations without the library:
 * no package has it. The machine is little-endian, as the floats of a payload are.
 */
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

/* --- msgpack: what the contract needs of it */

typedef struct {
    uint8_t bytes[4096];
    size_t n;
} buffer;

static void put_big_endian(buffer *to, uint64_t value, int n_bytes) {
    while (n_bytes--) to->bytes[to->n++] = (uint8_t)(value >> (8 * n_bytes));
}

static void put_map(buffer *to, unsigned n_keys) { /* up to 15: 0x80 + n, more: 0xde */
    if (n_keys < 16) to->bytes[to->n++] = (uint8_t)(0x80 | n_keys);
    else to->bytes[to->n++] = 0xde, put_big_endian(to, n_keys, 2);
}

static void put_array(buffer *to, unsigned n) {
    if (n < 16) to->bytes[to->n++] = (uint8_t)(0x90 | n);
    else to->bytes[to->n++] = 0xdc, put_big_endian(to, n, 2);
}

static void put_text(buffer *to, const char *text) { /* NULL: nil */
    size_t n = text ? strlen(text) : 0;
    if (!text) to->bytes[to->n++] = 0xc0;
    else if (n < 32) to->bytes[to->n++] = (uint8_t)(0xa0 | n);
    else to->bytes[to->n++] = 0xd9, to->bytes[to->n++] = (uint8_t)n; /* up to 255 */
    memcpy(to->bytes + to->n, text ? text : "", n);
    to->n += n;
}

static void put_integer(buffer *to, uint64_t value) {
    int n_bytes = value < 256 ? 1 : value < 65536 ? 2 : value >> 32 ? 8 : 4;
    if (value >= 128) to->bytes[to->n++] = n_bytes == 1 ? 0xcc : n_bytes == 2 ? 0xcd : n_bytes == 4 ? 0xce : 0xcf;
    put_big_endian(to, value, n_bytes);
}

static void put_number(buffer *to, double value) {
    uint64_t bits;
    memcpy(&bits, &value, 8);
    to->bytes[to->n++] = 0xcb;
    put_big_endian(to, bits, 8);
}

static void put_bool(buffer *to, bool value) { to->bytes[to->n++] = value ? 0xc3 : 0xc2; }

/* --- the contract */

enum { N_SLOPES = 4, N_MODES = 3, N_CONTROLLED = 2, N_FRAMES = 2 };
enum { N_COLUMNS = N_SLOPES + 2 * N_MODES };
static const char *BASIS = "kl-3", *CONFIG = "pyramid 2x2, mask 7";

static void put_ids(buffer *to) {
    put_text(to, "basis_id"), put_text(to, BASIS);
    put_text(to, "config_id"), put_text(to, CONFIG);
}

static buffer header(const char *session, uint64_t seq0, uint64_t t0_ns, const char *cm_id,
                     const char *reference_id) {
    buffer to = {.n = 0};
    put_map(&to, reference_id ? 13 : 12);
    put_text(&to, "v"), put_integer(&to, 1);
    put_text(&to, "session"), put_text(&to, session);
    put_text(&to, "seq0"), put_integer(&to, seq0);
    put_text(&to, "n"), put_integer(&to, N_FRAMES);
    put_text(&to, "t0_ns"), put_integer(&to, t0_ns);
    put_text(&to, "dt_ns"), put_integer(&to, 1000000);
    put_text(&to, "n_slopes"), put_integer(&to, N_SLOPES);
    put_text(&to, "n_modes"), put_integer(&to, N_MODES);
    put_text(&to, "dither"), put_bool(&to, true);
    put_text(&to, "cm_id"), put_text(&to, cm_id);
    put_ids(&to);
    if (reference_id) put_text(&to, "reference_id"), put_text(&to, reference_id); /* optional */
    return to;
}

static buffer status(const char *session, uint64_t t_ns) { /* before the first frame: seq nil */
    buffer to = {.n = 0};
    put_map(&to, 21);
    put_text(&to, "v"), put_integer(&to, 1);
    put_text(&to, "session"), put_text(&to, session);
    put_text(&to, "seq"), put_text(&to, NULL);
    put_text(&to, "t_ns"), put_integer(&to, t_ns);
    put_text(&to, "loop"), put_text(&to, "open");
    put_text(&to, "frame_rate_hz"), put_number(&to, 1000.0);
    put_text(&to, "delay_frames"), put_number(&to, 2.0);
    put_text(&to, "gains"), put_array(&to, N_MODES);
    for (int i = 0; i < N_MODES; i++) put_number(&to, 0.0);
    put_text(&to, "leak"), put_number(&to, 0.99);
    put_text(&to, "n_slopes"), put_integer(&to, N_SLOPES);
    put_text(&to, "n_modes"), put_integer(&to, N_MODES);
    put_text(&to, "n_controlled"), put_integer(&to, N_CONTROLLED);
    put_text(&to, "cm_id"), put_text(&to, NULL);
    put_ids(&to);
    put_text(&to, "dither"), put_text(&to, NULL);
    put_text(&to, "max_dither_m"), put_number(&to, 5e-8);
    put_text(&to, "max_dither_modes"), put_integer(&to, 8);
    put_text(&to, "magnitude"), put_text(&to, NULL);
    put_text(&to, "flux"), put_text(&to, NULL);
    put_text(&to, "pointing"), put_text(&to, NULL);
    return to;
}

/* slopes | commands, metres OPD | the dither's part of them; frame after frame */
static const float ROWS[N_FRAMES][N_COLUMNS] = {
    {0.5f, -0.25f, 0.125f, 0.0f, 1e-7f, -2e-7f, 5e-9f, 0.0f, 0.0f, 5e-9f},
    {0.25f, -0.5f, 0.0625f, 1.0f, 2e-7f, -1e-7f, -5e-9f, 0.0f, 0.0f, -5e-9f},
};

#ifdef WITH_ZENOH
#include <time.h>
#include <zenoh.h>

static void send(z_owned_session_t *session, const char *key, const void *data, size_t n, buffer *with) {
    z_view_keyexpr_t where;
    z_view_keyexpr_from_str(&where, key);
    z_owned_bytes_t payload, attachment;
    z_bytes_copy_from_buf(&payload, data, n);
    z_put_options_t options;
    z_put_options_default(&options);
    options.congestion_control = Z_CONGESTION_CONTROL_DROP;
    if (with) {
        z_bytes_copy_from_buf(&attachment, with->bytes, with->n);
        options.attachment = z_move(attachment);
    }
    z_put(z_loan(*session), z_loan(where), z_move(payload), &options);
}

int main(int argc, char **argv) {
    char endpoints[256], frames[128], statuses[128], alive[128], name[32];
    if (argc != 3) return fprintf(stderr, "usage: telemetry ENDPOINT SYSTEM\n"), 2;
    snprintf(endpoints, sizeof endpoints, "[\"%s\"]", argv[1]);
    snprintf(frames, sizeof frames, "ao/v1/%s/tel/frames", argv[2]);
    snprintf(statuses, sizeof statuses, "ao/v1/%s/tel/status", argv[2]);
    snprintf(alive, sizeof alive, "ao/v1/%s/alive/rtc", argv[2]);
    z_owned_config_t config;
    z_config_default(&config);
    zc_config_insert_json5(z_loan_mut(config), "mode", "\"client\"");
    zc_config_insert_json5(z_loan_mut(config), "connect/endpoints", endpoints);
    z_owned_session_t session;
    if (z_open(&session, z_move(config), NULL) < 0) return fprintf(stderr, "no router\n"), 1;
    z_view_keyexpr_t key;
    z_view_keyexpr_from_str(&key, alive);
    z_owned_liveliness_token_t token;
    z_liveliness_declare_token(z_loan(session), &token, z_loan(key), NULL);
    uint64_t start_ns = 1000000000ull * (uint64_t)time(NULL);
    snprintf(name, sizeof name, "c-%llu", (unsigned long long)start_ns);
    for (uint64_t seq = 0;; seq += N_FRAMES) { /* a loop would put its own slopes and commands here */
        buffer with = header(name, seq, start_ns + seq * 1000000, NULL, NULL);
        send(&session, frames, ROWS, sizeof ROWS, &with);
        if (seq % 200 == 0) {
            buffer said = status(name, start_ns + seq * 1000000);
            send(&session, statuses, said.bytes, said.n, NULL);
        }
        z_sleep_ms(N_FRAMES);
    }
}
#else
static int save(const char *folder, const char *name, const void *data, size_t n) {
    char path[1024];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, "wb");
    if (!file) return perror(path), 1;
    size_t written = fwrite(data, 1, n, file);
    return fclose(file) != 0 || written != n;
}

int main(int argc, char **argv) {
    if (argc != 2) return fprintf(stderr, "usage: telemetry FOLDER\n"), 2;
    buffer with = header("s-2027-01-15-1", 1000, 1800000000000000000ull, "start-5e2c", "ncpa-2027-01-15-a");
    buffer said = status("s-2027-01-15-1", 1800000000000000000ull);
    return save(argv[1], "frames.bin", ROWS, sizeof ROWS) ||
           save(argv[1], "frames.msgpack", with.bytes, with.n) ||
           save(argv[1], "status-minimal.msgpack", said.bytes, said.n);
}
#endif
