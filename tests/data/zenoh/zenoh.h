/* What examples/telemetry.c uses of zenoh-c 1.x, as its headers declare it: to check the source, not to link. */
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef int8_t z_result_t;
typedef struct z_loaned_config_t z_loaned_config_t;
typedef struct z_loaned_keyexpr_t z_loaned_keyexpr_t;
typedef struct z_loaned_session_t z_loaned_session_t;
typedef struct { uint64_t _0; } z_owned_bytes_t;
typedef struct { uint64_t _1; } z_owned_config_t;
typedef struct { uint64_t _2; } z_owned_liveliness_token_t;
typedef struct { uint64_t _3; } z_owned_session_t;
typedef struct { uint64_t _4; } z_view_keyexpr_t;
typedef struct { z_owned_bytes_t _this; } z_moved_bytes_t;
typedef struct { z_owned_config_t _this; } z_moved_config_t;
typedef struct z_open_options_t z_open_options_t;
typedef struct z_liveliness_token_options_t z_liveliness_token_options_t;
typedef enum { Z_CONGESTION_CONTROL_BLOCK, Z_CONGESTION_CONTROL_DROP } z_congestion_control_t;
typedef struct { z_congestion_control_t congestion_control; z_moved_bytes_t *attachment; } z_put_options_t;

z_result_t z_view_keyexpr_from_str(z_view_keyexpr_t *, const char *);
z_result_t z_bytes_copy_from_buf(z_owned_bytes_t *, const uint8_t *, size_t);
void z_put_options_default(z_put_options_t *);
z_result_t z_put(const z_loaned_session_t *, const z_loaned_keyexpr_t *, z_moved_bytes_t *, z_put_options_t *);
z_result_t z_config_default(z_owned_config_t *);
z_result_t zc_config_insert_json5(z_loaned_config_t *, const char *, const char *);
z_result_t z_open(z_owned_session_t *, z_moved_config_t *, const z_open_options_t *);
z_result_t z_liveliness_declare_token(const z_loaned_session_t *, z_owned_liveliness_token_t *,
                                      const z_loaned_keyexpr_t *, const z_liveliness_token_options_t *);
z_result_t z_sleep_ms(size_t);

z_moved_bytes_t *z_bytes_move(z_owned_bytes_t *);
z_moved_config_t *z_config_move(z_owned_config_t *);
const z_loaned_keyexpr_t *z_view_keyexpr_loan(const z_view_keyexpr_t *);
const z_loaned_session_t *z_session_loan(const z_owned_session_t *);
z_loaned_config_t *z_config_loan_mut(z_owned_config_t *);
#define z_move(of) _Generic((of), z_owned_bytes_t: z_bytes_move, z_owned_config_t: z_config_move)(&of)
#define z_loan(of) _Generic((of), z_view_keyexpr_t: z_view_keyexpr_loan, z_owned_session_t: z_session_loan)(&of)
#define z_loan_mut(of) _Generic((of), z_owned_config_t: z_config_loan_mut)(&of)
