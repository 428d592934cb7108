-- Written by bbe796ad.
BEGIN TRANSACTION;
CREATE TABLE annotation (
    t_ns_utc INTEGER NOT NULL, written_ns_utc INTEGER NOT NULL,
    who TEXT NOT NULL, note TEXT NOT NULL
);
CREATE TABLE audit (
    t_ns_utc INTEGER NOT NULL,
    who TEXT NOT NULL,
    name TEXT NOT NULL,
    text TEXT NOT NULL,
    address TEXT NOT NULL DEFAULT '', whence TEXT NOT NULL DEFAULT '', why TEXT NOT NULL DEFAULT '', answer TEXT NOT NULL DEFAULT '', cause TEXT NOT NULL DEFAULT ''
);
INSERT INTO "audit" VALUES(3,'operator','mode','auto','','','','','');
CREATE TABLE estimate (
    t_ns_utc INTEGER NOT NULL, source TEXT NOT NULL, entered INTEGER NOT NULL, in_use TEXT,
    innovation REAL, misfit REAL, measured_shift_x_subap REAL, measured_shift_y_subap REAL, measured_rotation_deg REAL, measured_magnification REAL, measured_sigma_shift_x_subap REAL, measured_sigma_shift_y_subap REAL, measured_sigma_rotation_deg REAL, measured_sigma_magnification REAL, filtered_shift_x_subap REAL, filtered_shift_y_subap REAL, filtered_rotation_deg REAL, filtered_magnification REAL, filtered_sigma_shift_x_subap REAL, filtered_sigma_shift_y_subap REAL, filtered_sigma_rotation_deg REAL, filtered_sigma_magnification REAL
);
CREATE TABLE measurement (
    id TEXT PRIMARY KEY,
    created_ns_utc INTEGER NOT NULL,
    record TEXT NOT NULL,
    product_sha256 TEXT
);
CREATE TABLE noisy_matrix (
    id TEXT PRIMARY KEY,
    created_ns_utc INTEGER NOT NULL,
    record TEXT NOT NULL,
    product_sha256 TEXT
);
CREATE TABLE pin (
    id TEXT PRIMARY KEY, who TEXT NOT NULL, why TEXT NOT NULL
);
CREATE TABLE reconstructor (
    id TEXT PRIMARY KEY,
    created_ns_utc INTEGER NOT NULL,
    record TEXT NOT NULL,
    product_sha256 TEXT
);
CREATE TABLE trend (
    t_ns_utc INTEGER, telemetry_ns_utc INTEGER, wavefront_m REAL, residual_m REAL, margin REAL, optical_gain REAL, n_controlled INTEGER, magnitude REAL, flux REAL, elevation_deg REAL, azimuth_deg REAL, alpha_shift_x_subap REAL, alpha_shift_y_subap REAL, alpha_rotation_deg REAL, alpha_magnification REAL, sigma_shift_x_subap REAL, sigma_shift_y_subap REAL, sigma_rotation_deg REAL, sigma_magnification REAL
);
CREATE INDEX audit_by_time ON audit (t_ns_utc);
CREATE INDEX estimate_by_time ON estimate (t_ns_utc);
CREATE INDEX audit_by_name ON audit (name, t_ns_utc);
CREATE INDEX trend_by_time ON trend (t_ns_utc);
CREATE INDEX annotation_by_time ON annotation (t_ns_utc);
CREATE TRIGGER audit_keeps_its_entries BEFORE DELETE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit trail only grows'); END;
CREATE TRIGGER audit_keeps_its_words BEFORE UPDATE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit trail only grows'); END;
COMMIT;
PRAGMA user_version = 5;
