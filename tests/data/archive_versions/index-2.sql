-- Written by fea640fa.
BEGIN TRANSACTION;
CREATE TABLE audit (
    t_ns_utc INTEGER NOT NULL,
    who TEXT NOT NULL,
    name TEXT NOT NULL,
    text TEXT NOT NULL
);
INSERT INTO "audit" VALUES(3,'operator','mode','auto');
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
CREATE TABLE reconstructor (
    id TEXT PRIMARY KEY,
    created_ns_utc INTEGER NOT NULL,
    record TEXT NOT NULL,
    product_sha256 TEXT
);
CREATE TRIGGER audit_keeps_its_entries BEFORE DELETE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit trail only grows'); END;
CREATE TRIGGER audit_keeps_its_words BEFORE UPDATE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit trail only grows'); END;
COMMIT;
PRAGMA user_version = 2;
