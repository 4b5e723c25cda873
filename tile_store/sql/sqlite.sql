-- Statements of the SQLite store. Times are int ns UTC, tiles are 39-bit Morton integers, versions count from 1.

-- name: schema
-- One row a published version. The body is the last column, so that history never reads it.
CREATE TABLE tile_version (
  layer      TEXT    NOT NULL,
  tile       INTEGER NOT NULL,
  version    INTEGER NOT NULL CHECK (version > 0),
  parent     INTEGER NOT NULL CHECK (parent >= 0 AND parent < version),
  kind       TEXT    NOT NULL CHECK (kind IN ('base', 'merged', 'rollback')),
  created_ns INTEGER NOT NULL,
  merger     TEXT    NOT NULL,
  n_reports  INTEGER NOT NULL CHECK (n_reports >= 0),
  sha        BLOB    NOT NULL CHECK (length(sha) = 32),
  codec_id   INTEGER NOT NULL,
  size_bytes INTEGER NOT NULL CHECK (size_bytes >= 0),
  provenance BLOB    NOT NULL,
  body       BLOB    NOT NULL,
  PRIMARY KEY (layer, tile, version)
) STRICT;
CREATE INDEX tile_version_sha ON tile_version (layer, tile, sha);

-- The compare-and-swap happens on this row. `epoch` is the latest version whose kind is base or rollback (0: none).
CREATE TABLE tile_head (
  layer   TEXT    NOT NULL,
  tile    INTEGER NOT NULL,
  version INTEGER NOT NULL,
  epoch   INTEGER NOT NULL,
  sha     BLOB    NOT NULL,
  PRIMARY KEY (layer, tile)
) STRICT, WITHOUT ROWID;

-- Versions whose update notice nobody has confirmed yet.
CREATE TABLE notice (
  layer      TEXT    NOT NULL,
  tile       INTEGER NOT NULL,
  version    INTEGER NOT NULL,
  created_ns INTEGER NOT NULL,
  PRIMARY KEY (layer, tile, version)
) STRICT, WITHOUT ROWID;

-- The inbox: one row a report and tile. `merged_in` is the head's version when the report was consumed (NULL: waiting).
CREATE TABLE report (
  arrival     INTEGER PRIMARY KEY,
  layer       TEXT    NOT NULL,
  tile        INTEGER NOT NULL,
  report_id   TEXT    NOT NULL,
  vehicle     TEXT    NOT NULL,
  received_ns INTEGER NOT NULL,
  seq         INTEGER NOT NULL,
  merged_in   INTEGER,
  base_sha    BLOB    NOT NULL,
  body        BLOB    NOT NULL
) STRICT;
CREATE UNIQUE INDEX report_key ON report (layer, tile, report_id);
CREATE INDEX report_waiting ON report (layer, tile, seq) WHERE merged_in IS NULL;

-- The queue of tiles to merge. `seq` counts what arrived; `token` fences off holders of an expired lease.
CREATE TABLE dirty (
  layer    TEXT    NOT NULL,
  tile     INTEGER NOT NULL,
  seq      INTEGER NOT NULL,
  waiting  INTEGER NOT NULL,
  ready_ns INTEGER NOT NULL,
  owner    TEXT,
  token    INTEGER,
  lease_ns INTEGER,
  attempts INTEGER NOT NULL DEFAULT 0,
  PRIMARY KEY (layer, tile)
) STRICT, WITHOUT ROWID;
CREATE INDEX dirty_ready ON dirty (ready_ns);
CREATE INDEX dirty_tile ON dirty (tile);

-- What was refused, with its reason; the same bytes are kept once.
CREATE TABLE quarantine (
  sha         BLOB    NOT NULL PRIMARY KEY,
  received_ns INTEGER NOT NULL,
  source      TEXT    NOT NULL,
  reason      TEXT    NOT NULL,
  times       INTEGER NOT NULL,
  body        BLOB    NOT NULL
) STRICT;

-- name: schema_of_confirmation
-- Added to the schema later: a store without it gets it when it is opened; a program that does not know it can go on.
-- What waits for a second witness: derived from the reports by each merge of the tile, in the publication's transaction.
CREATE TABLE IF NOT EXISTS waiting_change (
  layer    TEXT    NOT NULL,
  tile     INTEGER NOT NULL,
  vehicle  TEXT    NOT NULL,
  reason   TEXT    NOT NULL,
  voxels   INTEGER NOT NULL CHECK (voxels > 0),
  seen     INTEGER NOT NULL CHECK (seen >= voxels),
  since_ns INTEGER NOT NULL,
  PRIMARY KEY (layer, tile, vehicle, reason)
) STRICT, WITHOUT ROWID;

-- What the shift test says of each report: the account of its vehicle. Derived, too.
CREATE TABLE IF NOT EXISTS shift_test (
  layer     TEXT    NOT NULL,
  tile      INTEGER NOT NULL,
  report_id TEXT    NOT NULL,
  vehicle   TEXT    NOT NULL,
  at_ns     INTEGER NOT NULL,
  explained INTEGER NOT NULL CHECK (explained IN (0, 1)),
  length_m  REAL    NOT NULL,
  turn_rad  REAL    NOT NULL,
  forward_m REAL,
  left_m    REAL,
  PRIMARY KEY (layer, tile, report_id)
) STRICT, WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS shift_test_vehicle ON shift_test (vehicle, at_ns);

-- Where vehicles drive in their own frames, as their reports say.
CREATE TABLE IF NOT EXISTS course_said (
  layer     TEXT    NOT NULL,
  tile      INTEGER NOT NULL,
  report_id TEXT    NOT NULL,
  vehicle   TEXT    NOT NULL,
  at_ns     INTEGER NOT NULL,
  turn_rad  REAL    NOT NULL,
  sigma_rad REAL    NOT NULL,
  PRIMARY KEY (layer, tile, report_id)
) STRICT, WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS course_said_vehicle ON course_said (vehicle, at_ns);

-- The vehicles whose reports are shifted again and again: of them the merges of all their tiles know.
CREATE TABLE IF NOT EXISTS shifted_vehicle (
  vehicle  TEXT    NOT NULL PRIMARY KEY,
  since_ns INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

-- name: has_schema_of_confirmation
SELECT 1 FROM sqlite_schema WHERE type = 'table' AND name = 'shifted_vehicle'

-- name: schema_of_surveys
-- Added later, too. When the world was measured of which a base was built; versions without a row are older than this
-- table, or nobody has told.
CREATE TABLE IF NOT EXISTS survey (
  layer       TEXT    NOT NULL,
  tile        INTEGER NOT NULL,
  version     INTEGER NOT NULL,
  surveyed_ns INTEGER NOT NULL,
  PRIMARY KEY (layer, tile, version)
) STRICT, WITHOUT ROWID;
CREATE TRIGGER IF NOT EXISTS survey_goes AFTER DELETE ON tile_version BEGIN
  DELETE FROM survey WHERE layer = OLD.layer AND tile = OLD.tile AND version = OLD.version;
END;

-- name: has_schema_of_surveys
SELECT 1 FROM sqlite_schema WHERE type = 'trigger' AND name = 'survey_goes'

-- name: schema_of_parts
-- Added later, too. A report in short comes in two parts: 0 its flags (or the whole report), 1 with its Gaussians.
ALTER TABLE report ADD COLUMN part INTEGER NOT NULL DEFAULT 0 CHECK (part IN (0, 1));
DROP INDEX report_key;
CREATE UNIQUE INDEX report_key ON report (layer, tile, report_id, part);

-- name: has_schema_of_parts
SELECT 1 FROM pragma_table_info('report') WHERE name = 'part'

-- name: schema_of_journal
-- Added later, too. The journal of a tile: its reports, numbered (`seq`) in the order in which they became durable and cut
-- into windows. Reports that are older than this table are window 0.
ALTER TABLE report ADD COLUMN window INTEGER NOT NULL DEFAULT 0;
CREATE INDEX report_window ON report (layer, tile, window, seq, vehicle);
CREATE TABLE journal (
  layer     TEXT    NOT NULL,
  tile      INTEGER NOT NULL,
  seq       INTEGER NOT NULL,  -- of the newest entry; a mark without a report takes a number, too
  window    INTEGER NOT NULL,  -- that is open
  opened_ns INTEGER,           -- receipt of its first report; NULL: it has none yet
  PRIMARY KEY (layer, tile)
) STRICT, WITHOUT ROWID;
-- What the closed windows up to `window` have come to since version `epoch`: the next epoch, and what is remembered.
CREATE TABLE tile_memory (
  layer    TEXT    NOT NULL,
  tile     INTEGER NOT NULL,
  window   INTEGER NOT NULL,
  epoch    INTEGER NOT NULL,
  codec_id INTEGER NOT NULL,
  body     BLOB    NOT NULL,
  memory   BLOB    NOT NULL,
  PRIMARY KEY (layer, tile)
) STRICT;
-- What of the journal a version was made of: all windows before `window`, and of it the entries up to `seq`; a base or a
-- rollback begins with `window`. `named`: the vehicles that were named then.
CREATE TABLE version_basis (
  layer   TEXT    NOT NULL,
  tile    INTEGER NOT NULL,
  version INTEGER NOT NULL,
  window  INTEGER NOT NULL,
  seq     INTEGER NOT NULL,
  named   TEXT    NOT NULL,
  PRIMARY KEY (layer, tile, version)
) STRICT, WITHOUT ROWID;
CREATE TABLE closed_window (
  layer  TEXT    NOT NULL,
  tile   INTEGER NOT NULL,
  window INTEGER NOT NULL,
  named  TEXT    NOT NULL,
  PRIMARY KEY (layer, tile, window)
) STRICT, WITHOUT ROWID;

-- name: has_schema_of_journal
SELECT 1 FROM sqlite_schema WHERE type = 'table' AND name = 'closed_window'

-- name: schema_of_parameters
-- Step of the schema. What versions and folded windows were merged with, each text once; `digest` is its SHA-256. NULL: it
-- was merged before this step. Feature layers get windows: their reports that counted until now (of a vehicle the newest
-- 16, of a tile 256) are their window 0, the others count no more.
CREATE TABLE merge_parameters (
  number INTEGER PRIMARY KEY,
  digest BLOB    NOT NULL UNIQUE CHECK (length(digest) = 32),
  body   TEXT    NOT NULL
) STRICT;
ALTER TABLE version_basis ADD COLUMN parameters INTEGER;
ALTER TABLE closed_window ADD COLUMN parameters INTEGER;
UPDATE report SET window = -1 WHERE substr(layer, 1, 3) <> 'ndt' AND arrival NOT IN (
  SELECT arrival FROM (
    SELECT arrival, ROW_NUMBER() OVER (PARTITION BY layer, tile ORDER BY report_id DESC) AS place FROM (
      SELECT r.arrival, r.layer, r.tile, r.report_id,
        ROW_NUMBER() OVER (PARTITION BY r.layer, r.tile, r.vehicle ORDER BY r.report_id DESC) AS turn
      FROM report AS r LEFT JOIN tile_head AS h USING (layer, tile)
      WHERE r.merged_in IS NULL OR r.merged_in >= COALESCE(h.epoch, 0))
    WHERE turn <= 16)
  WHERE place <= 256);

-- name: has_schema_of_parameters
SELECT 1 FROM sqlite_schema WHERE type = 'table' AND name = 'merge_parameters'

-- name: put_parameters
INSERT INTO merge_parameters (digest, body) VALUES (:digest, :body) ON CONFLICT (digest) DO NOTHING

-- name: number_of_parameters
SELECT number FROM merge_parameters WHERE digest = :digest

-- name: parameters
SELECT digest, body FROM merge_parameters WHERE number = :number

-- name: journal
SELECT seq, window, opened_ns FROM journal WHERE layer = :layer AND tile = :tile

-- name: newest_entry
SELECT MAX(seq) FROM report WHERE layer = :layer AND tile = :tile

-- name: put_journal
INSERT INTO journal (layer, tile, seq, window, opened_ns) VALUES (:layer, :tile, :seq, :window, :opened_ns)
ON CONFLICT (layer, tile) DO UPDATE SET seq = excluded.seq, window = excluded.window, opened_ns = excluded.opened_ns

-- name: place_in_journal
-- Newest number and open window of a tile's journal, since when it is open; how many reports stand in it; how many vehicles,
-- but 0 where this one is among them; and whose the report is that has this key (NULL: it is new).
SELECT j.seq, j.window, j.opened_ns,
  (SELECT COUNT(*) FROM report AS r INDEXED BY report_window
   WHERE r.layer = j.layer AND r.tile = j.tile AND r.window = j.window),
  (SELECT CASE WHEN MAX(r.vehicle = :vehicle) THEN 0 ELSE COUNT(DISTINCT r.vehicle) END
   FROM report AS r INDEXED BY report_window WHERE r.layer = j.layer AND r.tile = j.tile AND r.window = j.window),
  (SELECT vehicle FROM report WHERE layer = :layer AND tile = :tile AND report_id = :report_id AND part = :part)
FROM journal AS j WHERE j.layer = :layer AND j.tile = :tile

-- name: place_without_journal
-- The same of a tile that has none yet: newest number, and whose the report is.
SELECT COALESCE(MAX(seq), 0), MAX(CASE WHEN report_id = :report_id AND part = :part THEN vehicle END) FROM report
WHERE layer = :layer AND tile = :tile

-- name: confirmed_version
-- The newest version, where it has this content and nothing waits to be merged or to be confirmed by others.
SELECT version FROM tile_head AS h WHERE h.layer = :layer AND h.tile = :tile AND h.sha = :base_sha
  AND NOT EXISTS (SELECT 1 FROM dirty AS d WHERE d.layer = h.layer AND d.tile = h.tile)
  AND NOT EXISTS (SELECT 1 FROM waiting_change AS w WHERE w.layer = h.layer AND w.tile = h.tile
                  AND w.reason IN ('share', 'contradicted') AND w.voxels >= :least)

-- name: move_waiting
UPDATE report INDEXED BY report_waiting SET window = :window
WHERE layer = :layer AND tile = :tile AND merged_in IS NULL AND window >= 0

-- name: oldest_of_window
SELECT MIN(received_ns) FROM report WHERE layer = :layer AND tile = :tile AND window = :window

-- name: put_basis
INSERT INTO version_basis (layer, tile, version, window, seq, named, parameters)
VALUES (:layer, :tile, :version, :window, :seq, :named, :parameters)

-- name: basis
SELECT window, seq, named, parameters FROM version_basis WHERE layer = :layer AND tile = :tile AND version = :version

-- name: put_closed_window
INSERT INTO closed_window (layer, tile, window, named, parameters)
VALUES (:layer, :tile, :window, :named, :parameters)
ON CONFLICT (layer, tile, window) DO UPDATE SET named = excluded.named, parameters = excluded.parameters

-- name: closed_windows
SELECT window, named, parameters FROM closed_window WHERE layer = :layer AND tile = :tile ORDER BY window

-- name: put_memory
INSERT INTO tile_memory (layer, tile, window, epoch, codec_id, body, memory)
VALUES (:layer, :tile, :window, :epoch, :codec_id, :body, :memory)
ON CONFLICT (layer, tile) DO UPDATE SET window = excluded.window, epoch = excluded.epoch, codec_id = excluded.codec_id,
  body = excluded.body, memory = excluded.memory

-- name: memory
SELECT window, codec_id, body, memory FROM tile_memory WHERE layer = :layer AND tile = :tile AND epoch = :epoch

-- name: folded_window
SELECT window FROM tile_memory WHERE layer = :layer AND tile = :tile AND epoch = :epoch

-- name: forget_memory
DELETE FROM tile_memory WHERE layer = :layer AND tile = :tile

-- name: reports_of_windows
SELECT report_id, layer, tile, vehicle, received_ns, body, base_sha, part, window, seq FROM report
WHERE layer = :layer AND tile = :tile AND window >= :first AND window <= :last AND seq <= :seq
ORDER BY report_id, part

-- name: windows
SELECT layer, tile, window, seq, opened_ns,
  (SELECT COUNT(*) FROM report AS r WHERE r.layer = j.layer AND r.tile = j.tile AND r.window = j.window),
  (SELECT m.window FROM tile_memory AS m WHERE m.layer = j.layer AND m.tile = j.tile)
FROM journal AS j ORDER BY layer, tile

-- name: put_survey
INSERT INTO survey (layer, tile, version, surveyed_ns) VALUES (:layer, :tile, :version, :surveyed_ns)
ON CONFLICT (layer, tile, version) DO UPDATE SET surveyed_ns = MAX(surveyed_ns, excluded.surveyed_ns)

-- name: shift_tests_of_tile
SELECT report_id, explained FROM shift_test
WHERE layer = :layer AND tile = :tile AND report_id IN (SELECT value FROM json_each(:ids))

-- name: put_shift_test
INSERT INTO shift_test (layer, tile, report_id, vehicle, at_ns, explained, length_m, turn_rad, forward_m, left_m)
VALUES (:layer, :tile, :report_id, :vehicle, :at_ns, :explained, :length_m, :turn_rad, :forward_m, :left_m)
ON CONFLICT (layer, tile, report_id) DO UPDATE SET explained = excluded.explained

-- name: courses_of_tile
SELECT report_id FROM course_said
WHERE layer = :layer AND tile = :tile AND report_id IN (SELECT value FROM json_each(:ids))

-- name: put_course
INSERT INTO course_said (layer, tile, report_id, vehicle, at_ns, turn_rad, sigma_rad)
VALUES (:layer, :tile, :report_id, :vehicle, :at_ns, :turn_rad, :sigma_rad)
ON CONFLICT (layer, tile, report_id) DO NOTHING

-- name: courses_of_vehicle
SELECT turn_rad, sigma_rad FROM course_said WHERE vehicle = :vehicle
ORDER BY at_ns DESC, layer, tile, report_id LIMIT :n

-- name: accounted_vehicles
SELECT vehicle FROM shift_test UNION SELECT vehicle FROM course_said ORDER BY vehicle

-- name: shift_tests_of_vehicle
SELECT explained, length_m, turn_rad, forward_m, left_m FROM shift_test WHERE vehicle = :vehicle
ORDER BY at_ns DESC, layer, tile, report_id LIMIT :n

-- name: shifted_vehicles
SELECT vehicle FROM shifted_vehicle ORDER BY vehicle

-- name: agreement_tests_of_tile
SELECT report_id, claims, refuted_claims, quotes, refuted_quotes, refuted, seen FROM agreement_test
WHERE layer = :layer AND tile = :tile AND report_id IN (SELECT value FROM json_each(:ids))

-- name: put_agreement_test
INSERT INTO agreement_test
  (layer, tile, report_id, vehicle, at_ns, claims, refuted_claims, quotes, refuted_quotes, refuted, seen)
VALUES
  (:layer, :tile, :report_id, :vehicle, :at_ns, :claims, :refuted_claims, :quotes, :refuted_quotes, :refuted, :seen)
ON CONFLICT (layer, tile, report_id) DO UPDATE
SET claims = excluded.claims, refuted_claims = excluded.refuted_claims, quotes = excluded.quotes,
    refuted_quotes = excluded.refuted_quotes, refuted = excluded.refuted, seen = excluded.seen

-- name: agreement_tests_of_vehicle
SELECT MAX(at_ns), claims, refuted_claims, quotes, refuted_quotes, refuted, seen FROM agreement_test
WHERE vehicle = :vehicle AND at_ns > COALESCE((SELECT until_ns FROM pardon WHERE vehicle = :vehicle), -1)
GROUP BY layer, tile ORDER BY MAX(at_ns) DESC, layer, tile LIMIT :n

-- name: newest_agreement_test
SELECT COALESCE(MAX(at_ns), 0) FROM agreement_test WHERE vehicle = :vehicle

-- name: tiles_spoken_of
SELECT r.layer, r.tile, MAX(r.window <= COALESCE(m.window, -1)) FROM report AS r
  LEFT JOIN tile_head AS h USING (layer, tile)
  LEFT JOIN tile_memory AS m ON m.layer = r.layer AND m.tile = r.tile AND m.epoch = h.epoch
WHERE r.vehicle = :vehicle AND (r.merged_in IS NULL OR r.merged_in >= COALESCE(h.epoch, 0))
GROUP BY r.layer, r.tile

-- name: oldest_since_epoch
SELECT MIN(seq) FROM report WHERE layer = :layer AND tile = :tile AND window >= :first

-- name: standings_of_tile
SELECT window, vehicle, at_ns, day, alone, shared, judged, denied, unheard FROM standing
WHERE layer = :layer AND tile = :tile AND window >= :first

-- name: put_standing
INSERT INTO standing (layer, tile, window, vehicle, at_ns, day, alone, shared, judged, denied, unheard)
VALUES (:layer, :tile, :window, :vehicle, :at_ns, :day, :alone, :shared, :judged, :denied, :unheard)
ON CONFLICT (layer, tile, window, vehicle) DO UPDATE
SET at_ns = excluded.at_ns, day = excluded.day, alone = excluded.alone, shared = excluded.shared,
    judged = excluded.judged, denied = excluded.denied, unheard = excluded.unheard

-- name: delete_standing
DELETE FROM standing WHERE layer = :layer AND tile = :tile AND window = :window AND vehicle = :vehicle

-- name: standings_of_vehicle
SELECT judged, denied FROM standing
WHERE vehicle = :vehicle AND judged > 0 AND at_ns > COALESCE((SELECT until_ns FROM pardon WHERE vehicle = :vehicle), -1)
ORDER BY at_ns DESC, layer, tile, window LIMIT :n

-- name: unheard_vehicles
SELECT vehicle, COUNT(*) FROM standing WHERE unheard > 0 GROUP BY vehicle ORDER BY vehicle

-- name: newest_standing
SELECT COALESCE(MAX(at_ns), 0) FROM standing WHERE vehicle = :vehicle

-- name: add_alone
INSERT INTO alone_day (vehicle, day, owner, alone, shared) VALUES (:vehicle, :day, :owner, :alone, :shared)
ON CONFLICT (vehicle, day) DO UPDATE
SET alone = alone_day.alone + excluded.alone, shared = alone_day.shared + excluded.shared

-- name: alone_of_owner
SELECT vehicle, alone, shared FROM alone_day WHERE day = :day AND owner = :owner AND alone > 0 ORDER BY vehicle

-- name: alone_of_vehicle
SELECT owner, alone, shared FROM alone_day WHERE day = :day AND vehicle = :vehicle

-- name: days_alone
SELECT vehicle, day, alone, shared FROM alone_day WHERE alone > 0 ORDER BY vehicle, day

-- name: lone_words_of_vehicle
SELECT day, since_ns, why FROM lone_word WHERE vehicle = :vehicle ORDER BY day

-- name: lone_words
SELECT vehicle, day, since_ns, why FROM lone_word ORDER BY vehicle, day

-- name: lone_words_of_tile
SELECT DISTINCT w.vehicle, w.day FROM lone_word AS w JOIN report AS r ON r.vehicle = w.vehicle
WHERE r.layer = :layer AND r.tile = :tile

-- name: vehicles_of_tile
SELECT DISTINCT vehicle FROM report WHERE layer = :layer AND tile = :tile

-- name: put_lone_word
INSERT INTO lone_word (vehicle, day, since_ns, why) VALUES (:vehicle, :day, :since_ns, :why)
ON CONFLICT (vehicle, day) DO UPDATE SET why = excluded.why

-- name: delete_lone_word
DELETE FROM lone_word WHERE vehicle = :vehicle AND day = :day

-- name: delete_lone_words
DELETE FROM lone_word WHERE vehicle = :vehicle AND day = 0

-- name: coincidences_of_tile
SELECT one, other, shared, by_chance, least FROM coincidence WHERE layer = :layer AND tile = :tile ORDER BY one, other

-- name: put_coincidence
INSERT INTO coincidence (layer, tile, one, other, shared, by_chance, least)
VALUES (:layer, :tile, :one, :other, :shared, :by_chance, :least)
ON CONFLICT (layer, tile, one, other) DO UPDATE
SET shared = excluded.shared, by_chance = excluded.by_chance, least = excluded.least

-- name: delete_coincidence
DELETE FROM coincidence WHERE layer = :layer AND tile = :tile AND one = :one AND other = :other

-- name: coincidence_of_pair
SELECT COALESCE(SUM(shared), 0), COALESCE(SUM(by_chance), 0.0), COALESCE(SUM(least), 0) FROM coincidence
WHERE one = :one AND other = :other

-- name: pairs_of_groups
SELECT g.one, g.other, SUM(c.shared), SUM(c.by_chance) FROM vehicle_group AS g JOIN coincidence AS c USING (one, other)
GROUP BY g.one, g.other ORDER BY g.one, g.other

-- name: put_pair_of_group
INSERT INTO vehicle_group (one, other, since_ns) VALUES (:one, :other, :since_ns) ON CONFLICT DO NOTHING

-- name: delete_pair_of_group
DELETE FROM vehicle_group WHERE one = :one AND other = :other

-- name: forget_standings
DELETE FROM standing WHERE at_ns < :before

-- name: forget_days_alone
DELETE FROM alone_day WHERE day < :before / 86400000000000

-- name: forget_old_places
DELETE FROM vehicle_place WHERE last_ns < :before

-- name: forget_impossible
DELETE FROM impossible_place WHERE at_ns < :before

-- name: places_of_vehicle
SELECT report_id, last_ns, west, south, east, north FROM vehicle_place WHERE vehicle = :vehicle
ORDER BY last_ns DESC, report_id LIMIT :n

-- name: put_place
INSERT INTO vehicle_place (vehicle, report_id, last_ns, west, south, east, north)
VALUES (:vehicle, :report_id, :last_ns, :west, :south, :east, :north)
ON CONFLICT (vehicle, report_id) DO NOTHING

-- name: forget_places
DELETE FROM vehicle_place WHERE vehicle = :vehicle AND last_ns < :before

-- name: put_impossible
INSERT INTO impossible_place (vehicle, times, since_ns, at_ns, why) VALUES (:vehicle, 1, :now, :now, :why)
ON CONFLICT (vehicle) DO UPDATE
SET times = impossible_place.times + 1, at_ns = excluded.at_ns, why = excluded.why

-- name: impossible_places
SELECT vehicle, times, since_ns, at_ns, why FROM impossible_place ORDER BY vehicle

-- name: refuted_tests
SELECT layer, tile, report_id, vehicle FROM agreement_test WHERE refuted = 1
ORDER BY at_ns DESC, layer, tile, report_id LIMIT :n

-- name: judged_vehicles
SELECT vehicle FROM agreement_test UNION SELECT vehicle FROM quarantined_vehicle ORDER BY vehicle

-- name: quarantined_vehicles
SELECT vehicle, since_ns, source, why FROM quarantined_vehicle ORDER BY vehicle

-- name: quarantine_vehicle
INSERT INTO quarantined_vehicle (vehicle, since_ns, source, why) VALUES (:vehicle, :since_ns, :source, :why)
ON CONFLICT (vehicle) DO UPDATE SET source = excluded.source, why = excluded.why WHERE excluded.source = 'operator'

-- name: release_vehicle
DELETE FROM quarantined_vehicle WHERE vehicle = :vehicle AND (source = 'agreement' OR :any)

-- name: put_owner
INSERT INTO vehicle_owner (vehicle, since_ns, owner)
SELECT :vehicle, :since_ns, :owner
WHERE :owner <> COALESCE((SELECT owner FROM vehicle_owner WHERE vehicle = :vehicle AND since_ns <= :since_ns
                          ORDER BY since_ns DESC LIMIT 1), '')
ON CONFLICT DO NOTHING

-- name: owners_of
SELECT vehicle, since_ns, owner FROM vehicle_owner WHERE vehicle IN (SELECT value FROM json_each(:ids))
ORDER BY vehicle, since_ns

-- name: owner_now
SELECT vehicle, since_ns, owner FROM vehicle_owner WHERE vehicle = :vehicle ORDER BY since_ns

-- name: owner_too
INSERT INTO vehicle_owner (vehicle, since_ns, owner)
SELECT :name, CASE WHEN since_ns = (SELECT MIN(since_ns) FROM vehicle_owner WHERE vehicle = :vehicle) THEN 0
                   ELSE since_ns END, owner
FROM vehicle_owner WHERE vehicle = :vehicle
ON CONFLICT DO NOTHING

-- name: erase_owner
DELETE FROM vehicle_owner WHERE vehicle = :vehicle

-- name: pardon_vehicle
INSERT INTO pardon (vehicle, until_ns) VALUES (:vehicle, :until_ns)
ON CONFLICT (vehicle) DO UPDATE SET until_ns = excluded.until_ns

-- name: refuted_reports
SELECT report_id FROM shift_test WHERE vehicle = :vehicle AND layer = :layer
GROUP BY report_id HAVING SUM(explained) >= :least AND SUM(explained) >= :share * COUNT(*)

-- name: distrust_vehicle
INSERT INTO shifted_vehicle (vehicle, since_ns) VALUES (:vehicle, :since_ns) ON CONFLICT (vehicle) DO NOTHING

-- name: trust_vehicle
DELETE FROM shifted_vehicle WHERE vehicle = :vehicle

-- name: tiles_of_vehicle
SELECT DISTINCT r.layer, r.tile FROM report AS r LEFT JOIN tile_head AS h USING (layer, tile)
  LEFT JOIN tile_memory AS m ON m.layer = r.layer AND m.tile = r.tile AND m.epoch = h.epoch
WHERE r.vehicle = :vehicle AND (r.merged_in IS NULL OR r.merged_in >= COALESCE(h.epoch, 0))
  AND r.window > COALESCE(m.window, -1)

-- name: tiles_claimed_alone
SELECT DISTINCT r.layer, r.tile FROM report AS r LEFT JOIN tile_head AS h USING (layer, tile)
  LEFT JOIN tile_memory AS m ON m.layer = r.layer AND m.tile = r.tile AND m.epoch = h.epoch
WHERE r.vehicle = :vehicle AND (r.merged_in IS NULL OR r.merged_in >= COALESCE(h.epoch, 0))
  AND r.window > COALESCE(m.window, -1)
  AND (EXISTS (SELECT 1 FROM standing AS s
               WHERE s.layer = r.layer AND s.tile = r.tile AND s.vehicle = r.vehicle AND s.alone > 0)
    OR EXISTS (SELECT 1 FROM waiting_change AS w
               WHERE w.layer = r.layer AND w.tile = r.tile AND w.vehicle = r.vehicle))

-- name: delete_waiting
DELETE FROM waiting_change WHERE layer = :layer AND tile = :tile

-- name: insert_waiting
INSERT INTO waiting_change (layer, tile, vehicle, reason, voxels, seen, since_ns)
VALUES (:layer, :tile, :vehicle, :reason, :voxels, :seen, :since_ns)

-- name: received
SELECT MIN(received_ns) FROM report WHERE layer = :layer AND tile = :tile AND report_id = :report_id

-- name: waiting_changes
SELECT layer, tile, vehicle, reason, voxels, seen, since_ns FROM waiting_change
ORDER BY layer, tile, vehicle, reason

-- name: waiting_changes_of_tile
SELECT layer, tile, vehicle, reason, voxels, seen, since_ns FROM waiting_change WHERE layer = :layer AND tile = :tile

-- name: dirty_tiles
SELECT layer, tile, waiting, attempts, owner IS NOT NULL, ready_ns FROM dirty WHERE aside_ns IS NULL ORDER BY layer, tile

-- name: queued_tiles
SELECT tile, COALESCE(aside_reason, 'is waiting to be merged') FROM dirty

-- name: unmerged_reports
SELECT tile, COUNT(*) FROM report WHERE merged_in IS NULL GROUP BY layer, tile

-- name: enter_report
-- A new report at its place in the journal; its tile is to be merged, unless it is settled already (`merged_in`, else 0).
INSERT INTO report (layer, tile, report_id, part, vehicle, received_ns, seq, window, merged_in, base_sha, body)
VALUES (:layer, :tile, :report_id, :part, :vehicle, :received_ns, :seq, :window, NULLIF(:merged_in, 0), :base_sha, :body);
INSERT INTO journal (layer, tile, seq, window, opened_ns) VALUES (:layer, :tile, :seq, :window, :opened_ns)
ON CONFLICT (layer, tile) DO UPDATE SET seq = excluded.seq, window = excluded.window, opened_ns = excluded.opened_ns;
INSERT INTO dirty (layer, tile, seq, waiting, ready_ns)
SELECT :layer, :tile, :seq, 1, CASE WHEN :merge_after <= 1 THEN :steady ELSE :steady + :delay END WHERE :merged_in = 0
ON CONFLICT (layer, tile) DO UPDATE SET
  seq = excluded.seq,
  waiting = waiting + 1,
  ready_ns = MIN(ready_ns, CASE WHEN waiting + 1 >= :merge_after THEN :steady ELSE :steady + :delay END),
  attempts = CASE WHEN aside_ns IS NULL THEN attempts ELSE 0 END,
  aside_ns = NULL,
  aside_reason = NULL

-- name: mark_dirty
INSERT INTO dirty (layer, tile, seq, waiting, ready_ns)
VALUES (:layer, :tile, :seq, 1, CASE WHEN :merge_after <= 1 THEN :steady ELSE :steady + :delay END)
ON CONFLICT (layer, tile) DO UPDATE SET
  seq = excluded.seq,
  waiting = waiting + 1,
  ready_ns = MIN(ready_ns, CASE WHEN waiting + 1 >= :merge_after THEN :steady ELSE :steady + :delay END),
  attempts = CASE WHEN aside_ns IS NULL THEN attempts ELSE 0 END,
  aside_ns = NULL,
  aside_reason = NULL

-- name: claimable
SELECT layer, tile, seq, attempts, aside_ns IS NOT NULL, ready_ns FROM dirty INDEXED BY dirty_ready
WHERE ready_ns <= :steady AND (owner IS NULL OR lease_ns <= :steady)
  AND COALESCE((SELECT state FROM district_owner WHERE district = dirty.tile / 1024),
      (SELECT state FROM district_owner WHERE district = -1), 'owned') IN ('owned', 'copying')
  -- a version of it is on trial: what is reported meanwhile waits for the verdict
  AND NOT EXISTS (SELECT 1 FROM trial AS t INDEXED BY trial_open WHERE t.state IN ('trial', 'paused')
    AND t.layer = dirty.layer AND t.tile = dirty.tile)
ORDER BY ready_ns, layer, tile LIMIT :n

-- name: take_lease
UPDATE dirty SET owner = :owner, token = :token, lease_ns = :lease_ns WHERE layer = :layer AND tile = :tile

-- name: begin_merge
UPDATE dirty SET attempts = attempts + 1, lease_ns = :lease_ns,
  ready_ns = CASE WHEN aside_ns IS NULL THEN ready_ns ELSE :again_ns END
WHERE layer = :layer AND tile = :tile AND token = :token

-- name: renew_lease
UPDATE dirty SET lease_ns = :lease_ns WHERE layer = :layer AND tile = :tile AND token = :token

-- name: release_owner
UPDATE dirty SET owner = NULL, token = NULL, lease_ns = NULL WHERE owner = :owner

-- name: release_token
UPDATE dirty SET owner = NULL, token = NULL, lease_ns = NULL, ready_ns = :ready_ns,
  attempts = attempts - CASE WHEN :blameless <> 0 AND attempts > 0 THEN 1 ELSE 0 END
WHERE layer = :layer AND tile = :tile AND token = :token

-- name: dirty_row
SELECT seq, token FROM dirty WHERE layer = :layer AND tile = :tile

-- name: consume_reports
UPDATE report SET merged_in = :version
WHERE layer = :layer AND tile = :tile AND merged_in IS NULL AND seq <= :seq

-- name: unknown_reports
SELECT value FROM json_each(:ids)
WHERE NOT EXISTS (SELECT 1 FROM report WHERE layer = :layer AND tile = :tile AND report_id = value)

-- name: clean
DELETE FROM dirty WHERE layer = :layer AND tile = :tile AND seq <= :seq

-- name: still_dirty
UPDATE dirty SET owner = NULL, token = NULL, lease_ns = NULL, attempts = 0,
  waiting = (SELECT COUNT(*) FROM report INDEXED BY report_waiting
             WHERE layer = :layer AND tile = :tile AND merged_in IS NULL),
  ready_ns = CASE WHEN (SELECT COUNT(*) FROM report INDEXED BY report_waiting
             WHERE layer = :layer AND tile = :tile AND merged_in IS NULL)
                       >= :merge_after THEN :steady ELSE :steady + :delay END
WHERE layer = :layer AND tile = :tile

-- name: head
SELECT version, epoch, sha FROM tile_head WHERE layer = :layer AND tile = :tile

-- name: newest_created
SELECT created_ns FROM tile_version WHERE layer = :layer AND tile = :tile ORDER BY version DESC LIMIT 1

-- name: insert_version
INSERT INTO tile_version (layer, tile, version, parent, kind, created_ns, merger, n_reports, sha, codec_id, size_bytes,
                          provenance, body, body_check, signer, signed_s, signature)
VALUES (:layer, :tile, :version, :parent, :kind, :created_ns, :merger, :n_reports, :sha, :codec_id, :size_bytes,
        :provenance, :body, :body_check, :signer, :signed_s, :signature)

-- name: insert_head
INSERT INTO tile_head (layer, tile, version, epoch, sha) VALUES (:layer, :tile, :version, :epoch, :sha)
ON CONFLICT (layer, tile) DO NOTHING

-- name: swap_head
UPDATE tile_head SET version = :version, epoch = :epoch, sha = :sha
WHERE layer = :layer AND tile = :tile AND version = :parent

-- name: insert_notice
INSERT INTO notice (layer, tile, version, created_ns) VALUES (:layer, :tile, :version, :created_ns)

-- name: delete_notice
DELETE FROM notice WHERE layer = :layer AND tile = :tile AND version = :version

-- name: notices
SELECT layer, tile, version FROM notice WHERE created_ns <= :before
  AND COALESCE((SELECT state FROM district_owner WHERE district = tile / 1024),
      (SELECT state FROM district_owner WHERE district = -1), 'owned') IN ('owned', 'copying')
ORDER BY created_ns, layer, tile, version LIMIT :n

-- name: stored_version
SELECT layer, tile, version, parent, kind, created_ns, merger, n_reports, sha, codec_id, body, surveyed_ns, body_check,
       signer, signed_s, signature
FROM tile_version LEFT JOIN survey USING (layer, tile, version)
WHERE layer = :layer AND tile = :tile AND version = :version

-- name: stored_heads
SELECT v.layer, v.tile, v.version, v.parent, v.kind, v.created_ns, v.merger, v.n_reports, v.sha, v.codec_id, v.body,
       s.surveyed_ns, v.body_check, v.signer, v.signed_s, v.signature
FROM json_each(:tiles) AS w CROSS JOIN tile_head AS h ON h.layer = :layer AND h.tile = w.value
  JOIN tile_version AS v USING (layer, tile, version)
  LEFT JOIN survey AS s USING (layer, tile, version)

-- name: stored_at
SELECT layer, tile, version, parent, kind, created_ns, merger, n_reports, sha, codec_id, body, surveyed_ns, body_check,
       signer, signed_s, signature
FROM tile_version LEFT JOIN survey USING (layer, tile, version)
WHERE layer = :layer AND tile = :tile AND created_ns <= :at_ns ORDER BY version DESC LIMIT 1

-- name: stored_by_sha
SELECT layer, tile, version, parent, kind, created_ns, merger, n_reports, sha, codec_id, body, surveyed_ns, body_check,
       signer, signed_s, signature
FROM tile_version LEFT JOIN survey USING (layer, tile, version)
WHERE layer = :layer AND tile = :tile AND sha = :sha ORDER BY version DESC LIMIT 1

-- name: heads
SELECT tile, version, sha FROM tile_head WHERE layer = :layer AND tile >= :first AND tile < :end ORDER BY tile

-- name: layers
SELECT DISTINCT layer FROM tile_head ORDER BY layer

-- name: districts
-- From the first tile of each district straight to the next district's: as many steps as districts, not as tiles.
WITH RECURSIVE step (district) AS (
  SELECT (SELECT MIN(tile) / 1024 FROM tile_head WHERE layer = :layer)
  UNION ALL
  SELECT (SELECT MIN(h.tile) / 1024 FROM tile_head AS h WHERE h.layer = :layer AND h.tile >= (district + 1) * 1024)
  FROM step WHERE district IS NOT NULL
)
SELECT district FROM step WHERE district IS NOT NULL

-- name: history
SELECT version, parent, kind, created_ns, merger, n_reports, sha, size_bytes FROM tile_version
WHERE layer = :layer AND tile = :tile ORDER BY version

-- name: provenance
SELECT provenance FROM tile_version WHERE layer = :layer AND tile = :tile AND version = :version

-- name: places_in_play
SELECT arrival, window, seq FROM report
WHERE layer = :layer AND tile = :tile AND window > :folded AND window <= :last
  AND (window > 0 OR merged_in IS NULL OR merged_in >= :epoch)

-- name: places_since
SELECT arrival, window, seq FROM report
WHERE layer = :layer AND tile = :tile AND window > :folded AND seq > :seq
  AND (window > 0 OR merged_in IS NULL OR merged_in >= :epoch)
ORDER BY seq

-- name: report_at
SELECT report_id, layer, tile, vehicle, received_ns, body, base_sha, part, window, seq FROM report
WHERE arrival = :arrival

-- name: reports_page
SELECT arrival, report_id, layer, tile, vehicle, received_ns, body, base_sha, part, window, seq FROM report
WHERE arrival > :after AND layer = :layer AND (:vehicle IS NULL OR vehicle = :vehicle) ORDER BY arrival LIMIT :n

-- name: dirty_count
SELECT COUNT(*) FROM dirty WHERE aside_ns IS NULL

-- name: next_ready
SELECT MIN(CASE WHEN owner IS NULL THEN ready_ns ELSE MAX(ready_ns, lease_ns) END) FROM dirty
WHERE COALESCE((SELECT state FROM district_owner WHERE district = dirty.tile / 1024),
      (SELECT state FROM district_owner WHERE district = -1), 'owned') IN ('owned', 'copying')
  AND NOT EXISTS (SELECT 1 FROM trial AS t INDEXED BY trial_open WHERE t.state IN ('trial', 'paused')
    AND t.layer = dirty.layer AND t.tile = dirty.tile)

-- name: insert_quarantine
INSERT INTO quarantine (sha, received_ns, source, reason, times, body)
VALUES (:sha, :received_ns, :source, :reason, 1, :body)
ON CONFLICT (sha) DO UPDATE SET times = times + 1, received_ns = excluded.received_ns

-- name: quarantined
SELECT received_ns, source, reason, times, body FROM quarantine ORDER BY received_ns, sha

-- name: tiles_with_history
SELECT layer, tile FROM tile_version GROUP BY layer, tile HAVING COUNT(*) > :keep

-- name: delete_old_versions
DELETE FROM tile_version WHERE layer = :layer AND tile = :tile
  AND version < :oldest AND version <> :epoch
  AND version NOT IN (SELECT base_version FROM trial
                      WHERE layer = :layer AND tile = :tile AND state IN ('trial', 'paused'))
  AND sha NOT IN (SELECT base_sha FROM report
                  WHERE layer = :layer AND tile = :tile AND window > :folded
                    AND (window > 0 OR merged_in IS NULL OR merged_in >= :epoch))
RETURNING size_bytes

-- name: counts
SELECT (SELECT COUNT(*) FROM tile_head), (SELECT COUNT(*) FROM tile_version),
       (SELECT COUNT(*) FROM (SELECT DISTINCT report_id FROM report) AS ids), (SELECT COUNT(*) FROM report),
       (SELECT COUNT(*) FROM report WHERE merged_in IS NULL),
       (SELECT COUNT(*) FROM dirty WHERE aside_ns IS NULL), (SELECT COUNT(*) FROM quarantine),
       (SELECT COUNT(*) FROM dirty WHERE aside_ns IS NOT NULL)

-- name: make_feature_source
-- Made with the first import: stores without one are as they were.
CREATE TABLE IF NOT EXISTS feature_source (
  name       TEXT    NOT NULL PRIMARY KEY,
  created_ns INTEGER NOT NULL,
  about      TEXT    NOT NULL,
  body       BLOB    NOT NULL
) STRICT

-- name: put_feature_source
INSERT INTO feature_source (name, created_ns, about, body) VALUES (:name, :created_ns, :about, :body)
ON CONFLICT (name) DO UPDATE SET created_ns = excluded.created_ns, about = excluded.about, body = excluded.body

-- name: feature_source_exists
SELECT 1 FROM sqlite_schema WHERE type = 'table' AND name = 'feature_source'

-- name: feature_sources
SELECT name, about, body FROM feature_source ORDER BY name

-- name: schema_of_uploads
-- Added later, too. What vehicles have sent, as the bytes that came, until it is understood; then what became of it.
-- `lease_ns` counts from the machine's start `boot` (lease_clock). `journal_id` is the report id in the journal.
CREATE TABLE IF NOT EXISTS upload (
  upload      INTEGER PRIMARY KEY,
  sha         BLOB    NOT NULL UNIQUE,
  key         TEXT    NOT NULL,
  body        BLOB    NOT NULL,
  report_id   TEXT    NOT NULL,
  vehicle     TEXT    NOT NULL,
  form        TEXT    NOT NULL CHECK (form IN ('packed', 'gaussians', 'whole', 'features')),
  received_ns INTEGER NOT NULL,
  state       TEXT    NOT NULL DEFAULT 'waiting'
    CHECK (state IN ('waiting', 'early', 'wanted', 'released', 'resend', 'quarantined')),
  wanted      BLOB    NOT NULL DEFAULT x'',
  reason      TEXT    NOT NULL DEFAULT '',
  journal_id  TEXT    NOT NULL DEFAULT '',
  home        TEXT    NOT NULL,
  owner       TEXT,
  token       INTEGER,
  boot        TEXT    NOT NULL,
  lease_ns    INTEGER NOT NULL,
  attempts    INTEGER NOT NULL DEFAULT 0
) STRICT;
CREATE INDEX IF NOT EXISTS upload_fresh ON upload (home, upload) WHERE state = 'waiting' AND attempts = 0;
CREATE INDEX IF NOT EXISTS upload_waiting ON upload (attempts, upload) WHERE state = 'waiting';
CREATE INDEX IF NOT EXISTS upload_report ON upload (report_id, upload);
CREATE INDEX IF NOT EXISTS upload_state ON upload (state, received_ns);

-- name: has_schema_of_uploads
SELECT 1 FROM sqlite_schema WHERE type = 'index' AND name = 'upload_state'

-- name: insert_upload
INSERT INTO upload (sha, key, body, report_id, vehicle, form, received_ns, home, boot, lease_ns)
VALUES (:sha, :key, :body, :report_id, :vehicle, :form, :received_ns, :home, :boot, :lease_ns)
ON CONFLICT (sha) DO NOTHING

-- name: turns_of_uploads
WITH RECURSIVE turn (vehicle) AS (
  SELECT MIN(vehicle) FROM upload INDEXED BY upload_turn
  WHERE state = 'waiting' AND attempts = 0 AND vehicle >= :after
  UNION ALL
  SELECT (SELECT MIN(vehicle) FROM upload INDEXED BY upload_turn
          WHERE state = 'waiting' AND attempts = 0 AND vehicle > turn.vehicle)
  FROM turn WHERE turn.vehicle IS NOT NULL
)
SELECT vehicle FROM turn WHERE vehicle IS NOT NULL LIMIT :n

-- name: fresh_uploads
SELECT upload, key, body, report_id, vehicle, form, received_ns, attempts FROM upload INDEXED BY upload_turn
WHERE state = 'waiting' AND attempts = 0 AND vehicle = :vehicle
  AND (home = :home OR boot <> :boot OR lease_ns <= :now OR lease_ns > :never)
  AND COALESCE((SELECT o.state FROM district_owner AS o WHERE o.path = substr(key, -17)),
      (SELECT o.state FROM district_owner AS o WHERE o.district = -1), 'owned') IN ('owned', 'copying')
ORDER BY upload LIMIT :n

-- name: oldest_fresh
SELECT lease_ns FROM upload INDEXED BY upload_waiting
WHERE state = 'waiting' AND attempts = 0 ORDER BY attempts, upload LIMIT 1

-- name: oldest_fresh_of
SELECT lease_ns FROM upload INDEXED BY upload_fresh
WHERE state = 'waiting' AND attempts = 0 AND home = :home ORDER BY upload LIMIT 1

-- name: oldest_of_home
SELECT vehicle FROM upload INDEXED BY upload_fresh
WHERE state = 'waiting' AND attempts = 0 AND home = :home ORDER BY upload LIMIT :n

-- name: any_fresh_upload
SELECT 1 FROM upload INDEXED BY upload_fresh WHERE state = 'waiting' AND attempts = 0 AND home = :home LIMIT 1

-- name: waiting_of_vehicle
SELECT COUNT(*) FROM (SELECT 1 FROM upload INDEXED BY upload_turn
                      WHERE state = 'waiting' AND attempts = 0 AND vehicle = :vehicle LIMIT :n) AS found

-- name: waiting_of_all
SELECT COUNT(*) FROM (SELECT 1 FROM upload INDEXED BY upload_waiting WHERE state = 'waiting' LIMIT :n) AS found

-- name: free_uploads
SELECT upload, key, body, report_id, vehicle, form, received_ns, attempts FROM upload INDEXED BY upload_waiting
WHERE state = 'waiting' AND (boot <> :boot OR lease_ns <= :now OR lease_ns > :never) AND attempts >= :attempts
  AND COALESCE((SELECT o.state FROM district_owner AS o WHERE o.path = substr(key, -17)),
      (SELECT o.state FROM district_owner AS o WHERE o.district = -1), 'owned') IN ('owned', 'copying')
ORDER BY attempts, upload LIMIT :n

-- name: any_free_upload
SELECT 1 FROM upload INDEXED BY upload_waiting
WHERE state = 'waiting' AND (boot <> :boot OR lease_ns <= :now OR lease_ns > :never) LIMIT 1

-- name: any_upload_left_behind
SELECT 1 FROM upload INDEXED BY upload_waiting
WHERE state = 'waiting' AND attempts >= 1 AND (boot <> :boot OR lease_ns <= :now OR lease_ns > :never) LIMIT 1

-- name: lease_upload
UPDATE upload SET owner = :owner, token = :token, boot = :boot, lease_ns = :lease_ns, attempts = attempts + 1
WHERE upload = :upload

-- name: postpone_upload
UPDATE upload SET owner = NULL, token = NULL, boot = :boot, lease_ns = :lease_ns,
  attempts = CASE WHEN :blameless THEN 1 ELSE attempts END
WHERE upload = :upload AND token = :token

-- name: release_uploads
UPDATE upload SET owner = NULL, token = NULL, lease_ns = 0
WHERE state = 'waiting' AND (owner = :owner OR (owner IS NULL AND attempts = 0 AND home = :owner))

-- name: settle_upload
UPDATE upload SET state = :state, wanted = :wanted, reason = :reason, journal_id = :journal_id,
  body = CASE WHEN :state = 'wanted' THEN body ELSE x'' END, owner = NULL, token = NULL
WHERE upload = :upload AND token = :token AND state = 'waiting'

-- name: wait_for_flags
UPDATE upload SET state = :state, wanted = :wanted, reason = :reason, journal_id = :journal_id,
  owner = NULL, token = NULL
WHERE upload = :upload AND token = :token AND state = 'waiting'
  AND NOT EXISTS (SELECT 1 FROM upload AS flags WHERE flags.report_id = upload.report_id AND flags.key = upload.key
                  AND flags.form = 'packed' AND flags.state <> 'waiting')

-- name: answer_first_half
UPDATE upload SET state = :state, reason = :reason, body = x'' WHERE upload = :number AND state = 'wanted'

-- name: wake_gaussians
UPDATE upload SET state = 'waiting', lease_ns = 0, attempts = 0
WHERE report_id = :report_id AND key = :key AND form = 'gaussians' AND state = 'early'

-- name: release_flags
UPDATE upload SET state = 'released', body = x''
WHERE report_id = :report_id AND vehicle = :vehicle AND form = 'packed' AND state IN ('wanted', 'resend', 'quarantined')

-- name: vehicle_of_report
SELECT vehicle FROM report WHERE layer = :layer AND tile = :tile AND report_id = :report_id AND part = :part

-- name: first_halves
SELECT upload, vehicle, state, wanted, journal_id, body FROM upload
WHERE report_id = :report_id AND key = :key AND form = 'packed' ORDER BY upload

-- name: report_part
SELECT report_id, layer, tile, vehicle, received_ns, body, base_sha, part FROM report
WHERE layer = :layer AND tile = :tile AND report_id = :report_id AND part = 0

-- name: upload_status
SELECT CASE WHEN u.state = 'wanted' AND EXISTS (
    SELECT 1 FROM upload AS half WHERE half.report_id = u.report_id AND half.key = u.key AND half.form = 'gaussians'
    AND half.state = 'waiting') THEN 'waiting' ELSE u.state END AS state, u.wanted, u.reason
FROM upload AS u WHERE u.report_id = :report_id AND u.vehicle = :vehicle ORDER BY u.upload DESC LIMIT 1

-- name: upload_counts
SELECT state, COUNT(*) FROM upload GROUP BY state

-- name: oldest_upload
SELECT MIN(received_ns) FROM upload WHERE state = 'waiting'

-- name: forget_uploads
DELETE FROM upload WHERE received_ns < :before_ns AND state <> 'waiting'

-- name: schema_of_operations
-- Step of the schema: the queue by a clock that does not step, tiles that are set aside, shards, bounds of the quarantine.
-- From here on `ready_ns` and `lease_ns` are times of the machine's monotonic clock, in the boot that `queue_boot` names.
ALTER TABLE dirty ADD COLUMN aside_ns INTEGER;
ALTER TABLE dirty ADD COLUMN aside_reason TEXT;
UPDATE dirty SET ready_ns = 0, owner = NULL, token = NULL, lease_ns = NULL;
CREATE TABLE queue_boot (
  one  INTEGER NOT NULL PRIMARY KEY CHECK (one = 1),
  boot TEXT    NOT NULL
) STRICT, WITHOUT ROWID;

-- The sign of life of each merger shard: `beat_ns` by the monotonic clock of that boot, `since_ns` UTC.
CREATE TABLE shard (
  owner    TEXT    NOT NULL PRIMARY KEY,
  boot     TEXT    NOT NULL,
  beat_ns  INTEGER NOT NULL,
  since_ns INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

-- How much the quarantine holds, kept by triggers: its bound is checked with each message that is refused.
CREATE TABLE quarantine_size (
  one      INTEGER NOT NULL PRIMARY KEY CHECK (one = 1),
  messages INTEGER NOT NULL,
  bytes    INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
INSERT INTO quarantine_size (one, messages, bytes)
SELECT 1, COUNT(*), COALESCE(SUM(LENGTH(body) + LENGTH(reason) + LENGTH(source)), 0) FROM quarantine;
CREATE INDEX quarantine_received ON quarantine (received_ns);
CREATE TRIGGER quarantine_grows AFTER INSERT ON quarantine BEGIN
  UPDATE quarantine_size SET messages = messages + 1,
    bytes = bytes + LENGTH(NEW.body) + LENGTH(NEW.reason) + LENGTH(NEW.source);
END;
CREATE TRIGGER quarantine_shrinks AFTER DELETE ON quarantine BEGIN
  UPDATE quarantine_size SET messages = messages - 1,
    bytes = bytes - LENGTH(OLD.body) - LENGTH(OLD.reason) - LENGTH(OLD.source);
END;
CREATE INDEX report_received ON report (received_ns);

-- name: boot_of_queue
SELECT boot FROM queue_boot

-- name: put_boot
INSERT INTO queue_boot (one, boot) VALUES (1, :boot) ON CONFLICT (one) DO UPDATE SET boot = excluded.boot

-- name: forget_leases
UPDATE dirty SET owner = NULL, token = NULL, lease_ns = NULL, ready_ns = :steady

-- name: forget_upload_leases
UPDATE upload SET owner = NULL, token = NULL, lease_ns = 0 WHERE state = 'waiting' AND lease_ns > 0

-- name: set_aside
UPDATE dirty SET owner = NULL, token = NULL, lease_ns = NULL, ready_ns = :again_ns,
  aside_ns = COALESCE(aside_ns, :now), aside_reason = :reason
WHERE layer = :layer AND tile = :tile AND token = :token

-- name: tiles_set_aside
SELECT layer, tile, aside_ns, attempts, waiting, aside_reason FROM dirty WHERE aside_ns IS NOT NULL ORDER BY layer, tile

-- name: take_up_again
UPDATE dirty SET ready_ns = :steady, attempts = 0, aside_ns = NULL, aside_reason = NULL
WHERE aside_ns IS NOT NULL AND layer = :layer AND tile = :tile

-- name: beat
INSERT INTO shard (owner, boot, beat_ns, since_ns) VALUES (:owner, :boot, :steady, :now)
ON CONFLICT (owner) DO UPDATE SET boot = excluded.boot, beat_ns = excluded.beat_ns

-- name: join
INSERT INTO shard (owner, boot, beat_ns, since_ns) VALUES (:owner, :boot, :steady, :now)
ON CONFLICT (owner) DO UPDATE SET boot = excluded.boot, beat_ns = excluded.beat_ns, since_ns = excluded.since_ns

-- name: forget_shards
DELETE FROM shard WHERE boot <> :boot OR beat_ns < :before

-- name: leave
DELETE FROM shard WHERE owner = :owner

-- name: shards
SELECT owner, boot, beat_ns, since_ns FROM shard ORDER BY owner

-- name: quarantine_size
SELECT messages, bytes FROM quarantine_size

-- name: forget_quarantined
DELETE FROM quarantine WHERE sha IN (SELECT sha FROM quarantine ORDER BY received_ns, sha LIMIT 16)

-- name: queue_state
SELECT (SELECT MIN(ready_ns) FROM dirty WHERE aside_ns IS NULL
  AND NOT EXISTS (SELECT 1 FROM trial AS t INDEXED BY trial_open WHERE t.state IN ('trial', 'paused')
    AND t.layer = dirty.layer AND t.tile = dirty.tile)),
       (SELECT MIN(r.received_ns) FROM dirty AS d JOIN report AS r INDEXED BY report_waiting USING (layer, tile)
        WHERE r.merged_in IS NULL AND d.aside_ns IS NULL)

-- name: head_lines
SELECT h.tile, v.version, v.created_ns, v.codec_id, v.size_bytes
FROM tile_head AS h JOIN tile_version AS v USING (layer, tile, version)
WHERE h.layer = :layer AND h.tile >= :first AND h.tile < :end ORDER BY h.tile

-- name: signed_heads
SELECT h.tile, v.signature FROM tile_head AS h JOIN tile_version AS v USING (layer, tile, version)
WHERE h.layer = :layer AND h.tile >= :first AND h.tile < :end

-- name: version_at
SELECT version FROM tile_version WHERE layer = :layer AND tile = :tile AND created_ns <= :at_ns
ORDER BY version DESC LIMIT 1

-- name: parent_of_next
SELECT parent FROM tile_version WHERE layer = :layer AND tile = :tile AND version > :version ORDER BY version LIMIT 1

-- name: sha_of_version
SELECT sha FROM tile_version WHERE layer = :layer AND tile = :tile AND version = :version

-- name: forget_reports
-- Only those that count no more: consumed before the tile's epoch began, or, if asked for, folded into its memory.
DELETE FROM report WHERE arrival IN (
  SELECT r.arrival FROM report AS r JOIN tile_head AS h USING (layer, tile)
    LEFT JOIN tile_memory AS m ON m.layer = r.layer AND m.tile = r.tile AND m.epoch = h.epoch
  WHERE r.received_ns < :before AND r.merged_in IS NOT NULL
    AND (r.merged_in < h.epoch OR r.window < 0 OR (:folded AND r.window > 0 AND r.window <= m.window))
  ORDER BY r.received_ns LIMIT :n)
RETURNING LENGTH(body)

-- name: forget_old_quarantined
DELETE FROM quarantine WHERE sha IN (SELECT sha FROM quarantine WHERE received_ns < :before ORDER BY received_ns LIMIT :n)
RETURNING LENGTH(body)

-- name: published_lags
-- How long the newest report parts that made a version waited for it, ns; an unchanged tile's version is older than they.
SELECT v.created_ns - r.received_ns FROM (SELECT layer, tile, merged_in, received_ns FROM report
  WHERE merged_in IS NOT NULL ORDER BY arrival DESC LIMIT :n) AS r
JOIN tile_version AS v ON v.layer = r.layer AND v.tile = r.tile AND v.version = r.merged_in
WHERE v.created_ns >= r.received_ns ORDER BY 1

-- name: keys_of_heads
SELECT layer, tile, version, sha FROM tile_head ORDER BY layer, tile

-- name: keys_of_versions
SELECT layer, tile, version, sha FROM tile_version INDEXED BY tile_version_sha

-- name: body_of_version
SELECT sha, codec_id, body FROM tile_version WHERE layer = :layer AND tile = :tile AND version = :version

-- name: keys_of_reports
SELECT layer, tile, report_id, arrival FROM report INDEXED BY report_key

-- name: body_of_report
SELECT body FROM report WHERE arrival = :arrival

-- name: end_of_a_copy
DELETE FROM queue_boot; DELETE FROM shard;
UPDATE upload SET owner = NULL, token = NULL, lease_ns = 0 WHERE state = 'waiting'

-- name: metrics
SELECT (SELECT COUNT(*) FROM tile_head), (SELECT COALESCE(MAX(arrival), 0) FROM report),
       (SELECT COUNT(*) FROM report INDEXED BY report_waiting WHERE merged_in IS NULL),
       (SELECT COUNT(*) FROM dirty WHERE aside_ns IS NULL), (SELECT COUNT(*) FROM dirty WHERE aside_ns IS NOT NULL)

-- name: is_fenced
-- Whether every write is refused because the store has moved (`copying.ends.REFUSE`).
SELECT 1 FROM sqlite_schema WHERE type = 'trigger' AND name = 'moved_away_insert_shard'

-- name: touch
UPDATE quarantine_size SET messages = messages

-- name: schema_of_new_roads
-- Added later, too. Roads that the map does not have: parts of surveys as they came, and what each tile has become.
CREATE TABLE IF NOT EXISTS road_part (
  arrival     INTEGER PRIMARY KEY,
  survey_id   TEXT    NOT NULL,
  part        INTEGER NOT NULL,
  report_id   TEXT    NOT NULL,
  layer       TEXT    NOT NULL,
  vehicle     TEXT    NOT NULL,
  received_ns INTEGER NOT NULL,
  body        BLOB    NOT NULL,
  UNIQUE (survey_id, part)
) STRICT;
CREATE INDEX IF NOT EXISTS road_part_layer ON road_part (layer, arrival);
CREATE TABLE IF NOT EXISTS road_tile (
  layer        TEXT    NOT NULL,
  tile         INTEGER NOT NULL,
  state        TEXT    NOT NULL CHECK (state IN ('draft', 'waiting', 'published')),
  reason       TEXT    NOT NULL,
  drives       INTEGER NOT NULL,
  vehicles     TEXT    NOT NULL,
  sigma_m      REAL    NOT NULL,
  apart_m      REAL,
  voxels       INTEGER NOT NULL,
  alone        INTEGER NOT NULL,
  first_ns     INTEGER NOT NULL,
  last_ns      INTEGER NOT NULL,
  updated_ns   INTEGER NOT NULL,
  base_version INTEGER NOT NULL,
  version      INTEGER NOT NULL,
  codec_id     INTEGER NOT NULL,
  body         BLOB    NOT NULL,
  PRIMARY KEY (layer, tile)
) STRICT, WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS road_work (
  layer    TEXT    PRIMARY KEY,
  done     INTEGER NOT NULL DEFAULT 0,
  owner    TEXT    NOT NULL DEFAULT '',
  boot     TEXT    NOT NULL DEFAULT '',
  lease_ns INTEGER NOT NULL DEFAULT 0
) STRICT, WITHOUT ROWID;

-- name: insert_road_part
INSERT INTO road_part (survey_id, part, report_id, layer, vehicle, received_ns, body)
VALUES (:survey_id, :part, :report_id, :layer, :vehicle, :received_ns, :body) ON CONFLICT (survey_id, part) DO NOTHING

-- name: heads_of_survey
SELECT part, report_id, layer, vehicle FROM road_part WHERE survey_id = :survey_id

-- name: open_road_layers
SELECT p.layer, COUNT(*), MIN(p.received_ns), MAX(p.received_ns), MAX(p.arrival)
FROM road_part AS p LEFT JOIN road_work AS w USING (layer) WHERE p.arrival > COALESCE(w.done, 0) GROUP BY p.layer

-- name: lease_roads
INSERT INTO road_work (layer, owner, boot, lease_ns) VALUES (:layer, :owner, :boot, :until)
ON CONFLICT (layer) DO UPDATE SET owner = excluded.owner, boot = excluded.boot, lease_ns = excluded.lease_ns
WHERE owner = '' OR owner = excluded.owner OR boot <> excluded.boot OR lease_ns <= :now

-- name: free_roads
UPDATE road_work SET owner = '', lease_ns = 0 WHERE layer = :layer AND owner = :owner

-- name: roads_done
UPDATE road_work SET done = MAX(done, :done) WHERE layer = :layer AND owner = :owner

-- name: road_parts
SELECT arrival, body FROM road_part WHERE layer = :layer ORDER BY arrival

-- name: road_reports
SELECT DISTINCT report_id FROM road_part WHERE layer = :layer

-- name: road_tiles
SELECT layer, tile, state, reason, drives, vehicles, sigma_m, apart_m, voxels, alone, first_ns, last_ns, updated_ns,
  base_version, version, codec_id, body FROM road_tile WHERE layer = :layer ORDER BY tile

-- name: put_road_tile
INSERT INTO road_tile VALUES (:layer, :tile, :state, :reason, :drives, :vehicles, :sigma_m, :apart_m, :voxels, :alone,
  :first_ns, :last_ns, :updated_ns, :base_version, :version, :codec_id, :body)
ON CONFLICT (layer, tile) DO UPDATE SET state = excluded.state, reason = excluded.reason, drives = excluded.drives,
  vehicles = excluded.vehicles, sigma_m = excluded.sigma_m, apart_m = excluded.apart_m, voxels = excluded.voxels,
  alone = excluded.alone, first_ns = excluded.first_ns, last_ns = excluded.last_ns, updated_ns = excluded.updated_ns,
  version = excluded.version, codec_id = excluded.codec_id, body = excluded.body

-- name: waits_to_be_merged
SELECT 1 FROM dirty WHERE layer = :layer AND tile = :tile

-- name: schema_of_trust
-- How reports agree with those of others; who does not count any more, and what was pardoned.
CREATE TABLE IF NOT EXISTS agreement_test (
  layer          TEXT    NOT NULL,
  tile           INTEGER NOT NULL,
  report_id      TEXT    NOT NULL,
  vehicle        TEXT    NOT NULL,
  at_ns          INTEGER NOT NULL,
  claims         INTEGER NOT NULL,
  refuted_claims INTEGER NOT NULL,
  quotes         INTEGER NOT NULL,
  refuted_quotes INTEGER NOT NULL,
  refuted        INTEGER NOT NULL CHECK (refuted IN (0, 1)),
  PRIMARY KEY (layer, tile, report_id)
) STRICT, WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS agreement_test_vehicle ON agreement_test (vehicle, at_ns);
CREATE TABLE IF NOT EXISTS quarantined_vehicle (
  vehicle  TEXT    NOT NULL PRIMARY KEY,
  since_ns INTEGER NOT NULL,
  source   TEXT    NOT NULL CHECK (source IN ('agreement', 'operator')),
  why      TEXT    NOT NULL
) STRICT, WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS pardon (
  vehicle  TEXT    NOT NULL PRIMARY KEY,
  until_ns INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

-- name: schema_of_owners
-- Step of the schema. Whose a vehicle is (a digest), as its certificate says, and from when on: a report counts as of who
-- owned its vehicle when it came.
CREATE TABLE vehicle_owner (
  vehicle  TEXT    NOT NULL,
  since_ns INTEGER NOT NULL,
  owner    TEXT    NOT NULL,
  PRIMARY KEY (vehicle, since_ns)
) STRICT, WITHOUT ROWID;

-- name: schema_of_standings
-- Step of the schema. How vehicles stand in windows of tiles; what each has changed alone on a day; who is not believed
-- alone (day 0: on none in particular); whose refuted claims coincide; where vehicles were last, in tiles, and who said to
-- have been where nobody can have been.
CREATE TABLE standing (
  layer   TEXT    NOT NULL,
  tile    INTEGER NOT NULL,
  window  INTEGER NOT NULL,
  vehicle TEXT    NOT NULL,
  at_ns   INTEGER NOT NULL,
  day     INTEGER NOT NULL,
  alone   INTEGER NOT NULL,
  shared  INTEGER NOT NULL,
  judged  INTEGER NOT NULL,
  denied  INTEGER NOT NULL,
  unheard INTEGER NOT NULL,
  PRIMARY KEY (layer, tile, window, vehicle)
) STRICT, WITHOUT ROWID;
CREATE INDEX standing_vehicle ON standing (vehicle, at_ns);
CREATE INDEX standing_time ON standing (at_ns);
CREATE TABLE alone_day (
  vehicle TEXT    NOT NULL,
  day     INTEGER NOT NULL,
  owner   TEXT    NOT NULL,
  alone   INTEGER NOT NULL,
  shared  INTEGER NOT NULL,
  PRIMARY KEY (vehicle, day)
) STRICT, WITHOUT ROWID;
CREATE INDEX alone_day_owner ON alone_day (day, owner);
CREATE TABLE lone_word (
  vehicle  TEXT    NOT NULL,
  day      INTEGER NOT NULL,
  since_ns INTEGER NOT NULL,
  why      TEXT    NOT NULL,
  PRIMARY KEY (vehicle, day)
) STRICT, WITHOUT ROWID;
CREATE TABLE coincidence (
  layer     TEXT    NOT NULL,
  tile      INTEGER NOT NULL,
  one       TEXT    NOT NULL,
  other     TEXT    NOT NULL,
  shared    INTEGER NOT NULL,
  by_chance REAL    NOT NULL,
  least     INTEGER NOT NULL,
  PRIMARY KEY (layer, tile, one, other)
) STRICT, WITHOUT ROWID;
CREATE INDEX coincidence_pair ON coincidence (one, other);
CREATE TABLE vehicle_group (
  one      TEXT    NOT NULL,
  other    TEXT    NOT NULL,
  since_ns INTEGER NOT NULL,
  PRIMARY KEY (one, other)
) STRICT, WITHOUT ROWID;
CREATE TABLE vehicle_place (
  vehicle   TEXT    NOT NULL,
  report_id TEXT    NOT NULL,
  last_ns   INTEGER NOT NULL,
  west      INTEGER NOT NULL,
  south     INTEGER NOT NULL,
  east      INTEGER NOT NULL,
  north     INTEGER NOT NULL,
  PRIMARY KEY (vehicle, report_id)
) STRICT, WITHOUT ROWID;
CREATE INDEX vehicle_place_time ON vehicle_place (vehicle, last_ns);
CREATE TABLE impossible_place (
  vehicle  TEXT    NOT NULL,
  times    INTEGER NOT NULL,
  since_ns INTEGER NOT NULL,
  at_ns    INTEGER NOT NULL,
  why      TEXT    NOT NULL,
  PRIMARY KEY (vehicle)
) STRICT, WITHOUT ROWID;

-- name: schema_of_turns
-- Step of the schema: uploads that nobody has looked at, by vehicle, to look at those of all vehicles in turn.
CREATE INDEX upload_turn ON upload (vehicle, upload) WHERE state = 'waiting' AND attempts = 0;

-- name: schema_of_trials
-- Step of the schema. Versions that only a share of the fleet gets at first. A version is on trial ("trial", "paused") until
-- it is "released", "withdrawn" or "superseded" (by a base, or by a rollback that somebody asked for).
CREATE TABLE trial (
  layer TEXT NOT NULL,
  tile INTEGER NOT NULL,
  version INTEGER NOT NULL,
  base_version INTEGER NOT NULL,
  share REAL NOT NULL,
  longest_ns INTEGER NOT NULL,
  since_ns INTEGER NOT NULL,
  state TEXT NOT NULL,
  settled_ns INTEGER,
  verdict TEXT NOT NULL DEFAULT '',
  PRIMARY KEY (layer, tile, version)
) STRICT, WITHOUT ROWID;
CREATE UNIQUE INDEX trial_open ON trial (layer, tile) WHERE state IN ('trial', 'paused');
CREATE INDEX trial_settled ON trial (settled_ns) WHERE settled_ns IS NOT NULL;
-- Who is among the first must not be foreseen.
CREATE TABLE trial_salt (one INTEGER PRIMARY KEY CHECK (one = 1), salt BLOB NOT NULL) STRICT;
INSERT INTO trial_salt VALUES (1, randomblob(16));
-- What vehicles have told of versions on trial and of those before them: one row, one vote a vehicle; gone when settled.
CREATE TABLE trial_health (
  layer TEXT NOT NULL,
  tile INTEGER NOT NULL,
  version INTEGER NOT NULL,
  vehicle TEXT NOT NULL,
  arm TEXT NOT NULL,
  first_ns INTEGER NOT NULL,
  t_ns INTEGER NOT NULL,
  scans INTEGER NOT NULL,
  matched INTEGER NOT NULL,
  fit INTEGER NOT NULL,
  elsewhere INTEGER NOT NULL,
  inside INTEGER NOT NULL,
  gated INTEGER NOT NULL,
  not_good INTEGER NOT NULL,
  has_left INTEGER NOT NULL,
  PRIMARY KEY (layer, tile, version, vehicle)
) STRICT, WITHOUT ROWID;
-- The reports behind a version that was withdrawn: their vehicles alone change nothing in this tile until they are cleared.
CREATE TABLE doubted_report (
  layer TEXT NOT NULL,
  tile INTEGER NOT NULL,
  version INTEGER NOT NULL,
  report_id TEXT NOT NULL,
  vehicle TEXT NOT NULL,
  since_ns INTEGER NOT NULL,
  cleared_ns INTEGER,
  cleared_by TEXT NOT NULL DEFAULT '',
  PRIMARY KEY (layer, tile, version, report_id)
) STRICT, WITHOUT ROWID;
CREATE INDEX doubted_open ON doubted_report (layer, tile) WHERE cleared_ns IS NULL;
-- Who did what to trials, and why.
CREATE TABLE trial_steered (
  at_ns INTEGER NOT NULL,
  who TEXT NOT NULL,
  action TEXT NOT NULL,
  layer TEXT NOT NULL,
  tile INTEGER NOT NULL,
  version INTEGER NOT NULL,
  why TEXT NOT NULL
) STRICT;
CREATE INDEX trial_steered_tile ON trial_steered (layer, tile, at_ns);

-- name: insert_trial
INSERT INTO trial (layer, tile, version, base_version, share, longest_ns, since_ns, state)
VALUES (:layer, :tile, :version, :base_version, :share, :longest_ns, :since_ns, 'trial')

-- name: open_trials
SELECT t.layer, t.tile, t.version, t.base_version, t.share, t.longest_ns, t.since_ns, t.state, t.settled_ns, t.verdict,
       b.sha, n.sha
FROM trial AS t INDEXED BY trial_open
  JOIN tile_version AS b ON b.layer = t.layer AND b.tile = t.tile AND b.version = t.base_version
  JOIN tile_version AS n ON n.layer = t.layer AND n.tile = t.tile AND n.version = t.version
WHERE t.state IN ('trial', 'paused') AND t.layer = :layer AND t.tile >= :first AND t.tile < :end ORDER BY t.tile

-- name: layers_on_trial
SELECT DISTINCT layer FROM trial INDEXED BY trial_open WHERE state IN ('trial', 'paused') ORDER BY layer

-- name: trials_of_tile
SELECT layer, tile, version, base_version, share, longest_ns, since_ns, state, settled_ns, verdict FROM trial
WHERE layer = :layer AND tile = :tile ORDER BY version

-- name: settled_trials
SELECT layer, tile, version, base_version, share, longest_ns, since_ns, state, settled_ns, verdict
FROM trial INDEXED BY trial_settled WHERE settled_ns IS NOT NULL ORDER BY settled_ns DESC, layer, tile LIMIT :n

-- name: set_trial
UPDATE trial SET state = :state, settled_ns = :settled_ns, verdict = :verdict
WHERE layer = :layer AND tile = :tile AND version = :version AND state IN ('trial', 'paused')

-- name: forget_trials
DELETE FROM trial WHERE settled_ns IS NOT NULL AND settled_ns <= (
  SELECT settled_ns FROM trial INDEXED BY trial_settled WHERE settled_ns IS NOT NULL
  ORDER BY settled_ns DESC LIMIT 1 OFFSET :keep)

-- name: trial_salt
SELECT salt FROM trial_salt

-- name: put_trial_health
INSERT INTO trial_health (layer, tile, version, vehicle, arm, first_ns, t_ns, scans, matched, fit, elsewhere, inside,
                          gated, not_good, has_left)
SELECT :layer, :tile, :version, :vehicle, :arm, :now, :t_ns, :scans, :matched, :fit, :elsewhere, :inside, :gated,
       :not_good, :has_left
WHERE (SELECT COUNT(*) FROM trial_health WHERE layer = :layer AND tile = :tile AND version = :version AND arm = :arm)
      < :most
  OR EXISTS (SELECT 1 FROM trial_health
             WHERE layer = :layer AND tile = :tile AND version = :version AND vehicle = :vehicle)
ON CONFLICT (layer, tile, version, vehicle) DO UPDATE SET
  t_ns = excluded.t_ns, scans = excluded.scans, matched = excluded.matched, fit = excluded.fit,
  elsewhere = excluded.elsewhere, inside = excluded.inside, gated = excluded.gated, not_good = excluded.not_good,
  has_left = excluded.has_left
WHERE excluded.t_ns > trial_health.t_ns AND excluded.arm = trial_health.arm
  AND (excluded.scans + excluded.inside > 0 OR trial_health.scans + trial_health.inside = 0)

-- name: trial_health
SELECT vehicle, arm, first_ns, t_ns, scans, matched, fit, elsewhere, inside, gated, not_good, has_left FROM trial_health
WHERE layer = :layer AND tile = :tile AND version = :version ORDER BY vehicle

-- name: trial_told
SELECT t_ns FROM trial_health
WHERE layer = :layer AND tile = :tile AND version = :version AND vehicle = :vehicle

-- name: forget_trial_health
DELETE FROM trial_health WHERE layer = :layer AND tile = :tile AND version = :version

-- name: put_doubted_report
INSERT INTO doubted_report (layer, tile, version, report_id, vehicle, since_ns)
SELECT :layer, :tile, :version, report_id, vehicle, :now FROM report
WHERE layer = :layer AND tile = :tile AND report_id IN (SELECT value FROM json_each(:ids)) GROUP BY report_id
ON CONFLICT (layer, tile, version, report_id) DO NOTHING

-- name: doubted_vehicles
SELECT DISTINCT vehicle FROM doubted_report INDEXED BY doubted_open
WHERE cleared_ns IS NULL AND layer = :layer AND tile = :tile

-- name: doubted_reports
SELECT version, report_id, vehicle, since_ns, cleared_ns, cleared_by FROM doubted_report
WHERE layer = :layer AND tile = :tile ORDER BY version, report_id

-- name: clear_doubted
UPDATE doubted_report SET cleared_ns = :now, cleared_by = :who
WHERE layer = :layer AND tile = :tile AND cleared_ns IS NULL

-- name: steer
INSERT INTO trial_steered (at_ns, who, action, layer, tile, version, why)
VALUES (:now, :who, :action, :layer, :tile, :version, :why)

-- name: steered
SELECT at_ns, who, action, version, why FROM trial_steered WHERE layer = :layer AND tile = :tile ORDER BY at_ns, rowid

-- name: rows_of_report
SELECT report_id, layer, tile, vehicle, received_ns, body, base_sha, part, window, seq FROM report
WHERE layer = :layer AND tile = :tile AND report_id = :report_id ORDER BY part

-- name: is_counted_out
SELECT 1 FROM quarantined_vehicle WHERE vehicle = :vehicle UNION ALL SELECT 1 FROM shifted_vehicle WHERE vehicle = :vehicle
UNION ALL SELECT 1 FROM lone_word WHERE vehicle = :vehicle

-- name: count_out_too
INSERT INTO quarantined_vehicle (vehicle, since_ns, source, why)
SELECT :name, since_ns, 'operator', :why FROM quarantined_vehicle WHERE vehicle = :vehicle

-- name: shift_too
INSERT INTO shifted_vehicle (vehicle, since_ns) SELECT :name, since_ns FROM shifted_vehicle WHERE vehicle = :vehicle

-- name: tiles_to_erase
SELECT DISTINCT layer, tile FROM report WHERE vehicle = :vehicle ORDER BY layer, tile

-- name: rows_to_erase
SELECT arrival, report_id, received_ns, body, base_sha, part, window, seq FROM report
WHERE layer = :layer AND tile = :tile AND vehicle = :vehicle ORDER BY arrival

-- name: report_ids_of_tile
SELECT DISTINCT report_id FROM report WHERE layer = :layer AND tile = :tile

-- name: provenances_of_tile
SELECT version, provenance FROM tile_version WHERE layer = :layer AND tile = :tile

-- name: put_provenance
UPDATE tile_version SET provenance = :provenance WHERE layer = :layer AND tile = :tile AND version = :version

-- name: put_erased_row
UPDATE report SET report_id = :report_id, vehicle = :vehicle, received_ns = :received_ns, body = :body
WHERE arrival = :arrival

-- name: named_basis_of_tile
SELECT layer, tile, version, named FROM version_basis
WHERE layer = :layer AND tile = :tile AND instr(named, :vehicle) > 0

-- name: named_basis_of_store
SELECT layer, tile, version, named FROM version_basis WHERE instr(named, :vehicle) > 0

-- name: put_named_basis
UPDATE version_basis SET named = :named WHERE layer = :layer AND tile = :tile AND version = :number

-- name: named_closed_of_tile
SELECT layer, tile, window, named FROM closed_window
WHERE layer = :layer AND tile = :tile AND instr(named, :vehicle) > 0

-- name: named_closed_of_store
SELECT layer, tile, window, named FROM closed_window WHERE instr(named, :vehicle) > 0

-- name: put_named_closed
UPDATE closed_window SET named = :named WHERE layer = :layer AND tile = :tile AND window = :number

-- name: rename_waiting_change
UPDATE waiting_change SET vehicle = :name WHERE layer = :layer AND tile = :tile AND vehicle = :vehicle

-- name: rename_doubted_report
UPDATE doubted_report SET vehicle = :name, report_id = :new_id
WHERE layer = :layer AND tile = :tile AND vehicle = :vehicle AND report_id = :report_id

-- name: memory_of_tile
SELECT memory FROM tile_memory WHERE layer = :layer AND tile = :tile

-- name: tiles_with_memory
SELECT layer, tile FROM tile_memory ORDER BY layer, tile

-- name: put_erased_memory
UPDATE tile_memory SET memory = :memory WHERE layer = :layer AND tile = :tile

-- name: count_uploads
SELECT COUNT(*) FROM upload
WHERE vehicle = :vehicle OR report_id IN (SELECT report_id FROM upload WHERE vehicle = :vehicle)

-- name: erase_uploads
DELETE FROM upload WHERE vehicle = :vehicle OR report_id IN (SELECT report_id FROM upload WHERE vehicle = :vehicle)

-- name: count_quarantined_messages
SELECT COUNT(*) FROM quarantine
WHERE instr(body, :name) > 0 OR instr(reason, :vehicle) > 0 OR instr(source, :vehicle) > 0

-- name: erase_quarantined_messages
DELETE FROM quarantine WHERE instr(body, :name) > 0 OR instr(reason, :vehicle) > 0 OR instr(source, :vehicle) > 0

-- name: count_shift_tests
SELECT COUNT(*) FROM shift_test WHERE vehicle = :vehicle

-- name: erase_shift_tests
DELETE FROM shift_test WHERE vehicle = :vehicle

-- name: count_courses
SELECT COUNT(*) FROM course_said WHERE vehicle = :vehicle

-- name: erase_courses
DELETE FROM course_said WHERE vehicle = :vehicle

-- name: count_agreement_tests
SELECT COUNT(*) FROM agreement_test WHERE vehicle = :vehicle

-- name: erase_agreement_tests
DELETE FROM agreement_test WHERE vehicle = :vehicle

-- name: count_trial_health
SELECT COUNT(*) FROM trial_health WHERE vehicle = :vehicle

-- name: erase_trial_health
DELETE FROM trial_health WHERE vehicle = :vehicle

-- name: count_road_parts
SELECT COUNT(*) FROM road_part WHERE vehicle = :vehicle

-- name: erase_road_parts
DELETE FROM road_part WHERE vehicle = :vehicle

-- name: count_standings
SELECT COUNT(*) FROM standing WHERE vehicle = :vehicle

-- name: erase_standings
DELETE FROM standing WHERE vehicle = :vehicle

-- name: count_days_alone
SELECT COUNT(*) FROM alone_day WHERE vehicle = :vehicle

-- name: erase_days_alone
DELETE FROM alone_day WHERE vehicle = :vehicle

-- name: count_coincidences
SELECT COUNT(*) FROM coincidence WHERE one = :vehicle OR other = :vehicle

-- name: erase_coincidences
DELETE FROM coincidence WHERE one = :vehicle OR other = :vehicle

-- name: count_pairs_of_groups
SELECT COUNT(*) FROM vehicle_group WHERE one = :vehicle OR other = :vehicle

-- name: erase_pairs_of_groups
DELETE FROM vehicle_group WHERE one = :vehicle OR other = :vehicle

-- name: count_places
SELECT COUNT(*) FROM vehicle_place WHERE vehicle = :vehicle

-- name: erase_places
DELETE FROM vehicle_place WHERE vehicle = :vehicle

-- name: count_impossible
SELECT COUNT(*) FROM impossible_place WHERE vehicle = :vehicle

-- name: erase_impossible
DELETE FROM impossible_place WHERE vehicle = :vehicle

-- name: count_lone_words
SELECT COUNT(*) FROM lone_word WHERE vehicle = :vehicle

-- name: erase_lone_words
DELETE FROM lone_word WHERE vehicle = :vehicle

-- name: lone_word_too
INSERT INTO lone_word (vehicle, day, since_ns, why) SELECT :name, day, since_ns, why FROM lone_word WHERE vehicle = :vehicle

-- name: erase_pardon
DELETE FROM pardon WHERE vehicle = :vehicle

-- name: erase_quarantined
DELETE FROM quarantined_vehicle WHERE vehicle = :vehicle

-- name: erase_shifted
DELETE FROM shifted_vehicle WHERE vehicle = :vehicle

-- name: erase_left_waiting
UPDATE waiting_change SET vehicle = :other WHERE vehicle = :vehicle

-- name: erase_left_doubted
UPDATE doubted_report SET vehicle = :other WHERE vehicle = :vehicle

-- name: road_tiles_of_vehicles
SELECT layer, tile, vehicles FROM road_tile ORDER BY layer, tile

-- name: put_road_vehicles
UPDATE road_tile SET vehicles = :vehicles WHERE layer = :layer AND tile = :tile

-- name: schema_of_signatures
-- Step of the schema. Who answers for a version: the id of the signer's certificate, when it was signed (s, POSIX time),
-- and the signature over what `gnd.schemas.version_signature` says. The certificates are kept once each: versions stay
-- checkable when they have ended.
ALTER TABLE tile_version ADD COLUMN signer BLOB CHECK (signer IS NULL OR length(signer) = 8);
ALTER TABLE tile_version ADD COLUMN signed_s INTEGER;
ALTER TABLE tile_version ADD COLUMN signature BLOB CHECK (signature IS NULL OR length(signature) = 64);
CREATE TABLE publisher (
  signer  BLOB    NOT NULL PRIMARY KEY CHECK (length(signer) = 8),
  chain   BLOB    NOT NULL,
  since_s INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

-- name: any_publisher
SELECT 1 FROM publisher LIMIT 1

-- name: put_publisher
INSERT INTO publisher (signer, chain, since_s) VALUES (:signer, :chain, :since_s) ON CONFLICT (signer) DO NOTHING

-- name: chain_of_publisher
SELECT chain FROM publisher WHERE signer = :signer

-- name: set_signature
UPDATE tile_version SET signer = :signer, signed_s = :signed_s, signature = :signature
WHERE layer = :layer AND tile = :tile AND version = :version

-- name: unsigned_heads
SELECT COUNT(*) FROM tile_head JOIN tile_version USING (layer, tile, version) WHERE signature IS NULL

-- name: size_of_version
SELECT size_bytes FROM tile_version WHERE layer = :layer AND tile = :tile AND version = :version

-- name: schema_of_bodies
-- Step of the schema. Where the bodies of versions lie that are empty here, and whether new ones go there; and bodies that
-- are about to be removed there, or were lately.
CREATE TABLE body_place (
  number   INTEGER NOT NULL PRIMARY KEY CHECK (number = 1),
  location TEXT    NOT NULL,
  takes    INTEGER NOT NULL CHECK (takes IN (0, 1))
) STRICT;
CREATE TABLE body_going (
  sha      BLOB    NOT NULL CHECK (length(sha) = 32),
  codec_id INTEGER NOT NULL,
  since_ns INTEGER NOT NULL,
  PRIMARY KEY (sha, codec_id)
) STRICT, WITHOUT ROWID;
CREATE INDEX tile_version_elsewhere ON tile_version (sha, codec_id) WHERE length(body) = 0;

-- name: schema_of_body_checks
-- Step of the schema. `gnd.tile_store.values.check_of_body` of what was encoded when the version was made, wherever the
-- body lies by now; NULL: the version is older than this column.
ALTER TABLE tile_version ADD COLUMN body_check BLOB CHECK (body_check IS NULL OR length(body_check) = 16);

-- name: place_of_bodies
SELECT location FROM body_place

-- name: takes_bodies
SELECT 1 FROM body_place WHERE takes = 1

-- name: put_place_of_bodies
INSERT INTO body_place (number, location, takes) VALUES (1, :location, :takes)
ON CONFLICT (number) DO UPDATE SET location = excluded.location, takes = excluded.takes

-- name: forget_place_of_bodies
DELETE FROM body_place WHERE NOT EXISTS (SELECT 1 FROM tile_version WHERE length(body) = 0)

-- name: names_body
SELECT 1 FROM tile_version WHERE sha = :sha AND codec_id = :codec_id AND length(body) = 0 LIMIT 1

-- name: body_going
SELECT 1 FROM body_going WHERE sha = :sha AND codec_id = :codec_id

-- name: put_body_going
INSERT INTO body_going (sha, codec_id, since_ns) VALUES (:sha, :codec_id, :since_ns)
ON CONFLICT (sha, codec_id) DO UPDATE SET since_ns = excluded.since_ns

-- name: forget_bodies_going
DELETE FROM body_going WHERE since_ns < :before

-- name: bodies_here
SELECT layer, tile, version, sha, codec_id, body FROM tile_version
WHERE (layer, tile, version) > (:layer, :tile, :version) AND length(body) > 0 ORDER BY layer, tile, version LIMIT :n

-- name: bodies_elsewhere
SELECT layer, tile, version, sha, codec_id FROM tile_version
WHERE (layer, tile, version) > (:layer, :tile, :version) AND length(body) = 0 ORDER BY layer, tile, version LIMIT :n

-- name: set_body
UPDATE tile_version SET body = :body WHERE layer = :layer AND tile = :tile AND version = :version

-- name: copy_has_begun
-- Whether the store notes its changes for a copy, or has moved.
SELECT 1 FROM sqlite_schema WHERE type = 'trigger' AND (name LIKE 'copy\_notes\_%' ESCAPE '\' OR name LIKE 'moved\_away\_%' ESCAPE '\') LIMIT 1

-- name: schema_of_districts
-- Step of the schema. Whose districts are: a district's number is that of its tiles / 1024; -1 stands for all that have no
-- row. Without any row the store has all. `place` is how far a move has come, `other` the store at its other end.
CREATE TABLE district_owner (
  district INTEGER NOT NULL PRIMARY KEY CHECK (district >= -1),
  path     TEXT    NOT NULL UNIQUE,
  region   TEXT    NOT NULL,
  state    TEXT    NOT NULL CHECK (state IN ('owned', 'copying', 'leaving', 'moved', 'arriving')),
  other    TEXT    NOT NULL,
  since_ns INTEGER NOT NULL,
  epoch    INTEGER NOT NULL,
  move_id  TEXT    NOT NULL,
  place    TEXT    NOT NULL
) STRICT;
-- What a report about features says of tiles across the border of a district of another store, until it is carried there.
CREATE TABLE border_row (
  layer       TEXT    NOT NULL,
  tile        INTEGER NOT NULL,
  report_id   TEXT    NOT NULL,
  part        INTEGER NOT NULL,
  vehicle     TEXT    NOT NULL,
  received_ns INTEGER NOT NULL,
  base_sha    BLOB    NOT NULL,
  body        BLOB    NOT NULL,
  PRIMARY KEY (layer, tile, report_id, part)
) STRICT, WITHOUT ROWID;
CREATE INDEX border_row_received ON border_row (received_ns);

-- name: put_border_row
INSERT INTO border_row (layer, tile, report_id, part, vehicle, received_ns, base_sha, body)
VALUES (:layer, :tile, :report_id, :part, :vehicle, :received_ns, :base_sha, :body) ON CONFLICT DO NOTHING

-- name: border_rows
SELECT report_id, layer, tile, vehicle, received_ns, body, base_sha, part FROM border_row
ORDER BY received_ns, layer, tile, report_id, part LIMIT :n

-- name: count_border_rows
SELECT COUNT(*) FROM border_row WHERE :vehicle = '' OR vehicle = :vehicle

-- name: forget_border_row
DELETE FROM border_row WHERE layer = :layer AND tile = :tile AND report_id = :report_id AND part = :part

-- name: erase_border_rows
DELETE FROM border_row WHERE vehicle = :vehicle

-- name: district_owners
SELECT district, path, region, state, other, since_ns, epoch FROM district_owner ORDER BY district

-- name: put_rest
INSERT INTO district_owner (district, path, region, state, other, since_ns, epoch, move_id, place)
VALUES (-1, '', :region, :state, '', :since_ns, 0, '', '')
ON CONFLICT (district) DO UPDATE SET region = excluded.region, state = excluded.state

-- name: state_of_district
SELECT COALESCE((SELECT state FROM district_owner WHERE district = :district),
                (SELECT state FROM district_owner WHERE district = -1), 'owned')

-- name: schema_of_catalogs
-- Step of the schema. What a publisher has signed of the released versions of a district (`gnd.schemas.catalog_signature`):
-- `tile` is the first of the district, `tiles` how many there are, `digests` those of its groups.
CREATE TABLE catalog_state (
  layer     TEXT    NOT NULL,
  tile      INTEGER NOT NULL CHECK (tile % 1024 = 0),
  tiles     INTEGER NOT NULL CHECK (tiles BETWEEN 1 AND 1024),
  digests   BLOB    NOT NULL CHECK (length(digests) = 1024),
  number    INTEGER NOT NULL CHECK (number > 0),
  signed_s  INTEGER NOT NULL,
  kind      TEXT    NOT NULL CHECK (kind IN ('published', 'rollback', 'renewed', 'whole')),
  signer    BLOB    NOT NULL CHECK (length(signer) = 8),
  signature BLOB    NOT NULL CHECK (length(signature) = 64),
  PRIMARY KEY (layer, tile)
) STRICT;
CREATE INDEX catalog_state_signed ON catalog_state (layer, signed_s, signer);

-- name: catalog_state
SELECT tiles, digests, number, signed_s, kind, signer, signature FROM catalog_state
WHERE layer = :layer AND tile = :tile

-- name: put_catalog_state
INSERT INTO catalog_state (layer, tile, tiles, digests, number, signed_s, kind, signer, signature)
VALUES (:layer, :tile, :tiles, :digests, :number, :signed_s, :kind, :signer, :signature)
ON CONFLICT (layer, tile) DO UPDATE SET tiles = excluded.tiles, digests = excluded.digests, number = excluded.number,
  signed_s = excluded.signed_s, kind = excluded.kind, signer = excluded.signer, signature = excluded.signature

-- name: forget_catalog_state
DELETE FROM catalog_state WHERE layer = :layer AND tile = :tile

-- name: places_of_catalogs
SELECT tile / 1024 FROM catalog_state WHERE layer = :layer

-- name: catalogs_signed_before
SELECT tile / 1024 FROM catalog_state WHERE layer = :layer AND signed_s < :before ORDER BY signed_s, tile

-- name: signers_of_catalogs
SELECT DISTINCT signer FROM catalog_state WHERE layer = :layer

-- name: catalogs_of_signer
SELECT tile / 1024 FROM catalog_state WHERE layer = :layer AND signer = :signer

-- name: any_head
SELECT 1 FROM tile_head WHERE layer = :layer AND tile >= :first AND tile < :end LIMIT 1

-- name: newest_of_district
SELECT tile, MAX(version) FROM tile_version WHERE layer = :layer AND tile >= :first AND tile < :end GROUP BY tile

-- name: schema_of_lists
-- Step of the schema. Which districts a layer has, as a publisher has signed it (`gnd.schemas.district_list`):
-- `districts` holds their numbers (tile / 1024), ascending, 8 bytes each, little-endian.
CREATE TABLE district_list (
  layer     TEXT    NOT NULL PRIMARY KEY,
  region    TEXT    NOT NULL,
  districts BLOB    NOT NULL CHECK (length(districts) % 8 = 0),
  number    INTEGER NOT NULL CHECK (number > 0),
  signed_s  INTEGER NOT NULL,
  signer    BLOB    NOT NULL CHECK (length(signer) = 8),
  signature BLOB    NOT NULL CHECK (length(signature) = 64)
) STRICT;

-- name: schema_of_seen
-- Step of the schema. How many voxels of the tile that hold something a judged report has seen; 0: not noted.
ALTER TABLE agreement_test ADD COLUMN seen INTEGER NOT NULL DEFAULT 0 CHECK (seen >= 0);

-- name: district_list
SELECT region, districts, number, signed_s, signer, signature FROM district_list WHERE layer = :layer

-- name: number_of_list
SELECT number FROM district_list WHERE layer = :layer

-- name: insert_district_list
INSERT INTO district_list (layer, region, districts, number, signed_s, signer, signature)
VALUES (:layer, :region, :districts, :number, :signed_s, :signer, :signature)
ON CONFLICT (layer) DO NOTHING

-- name: swap_district_list
UPDATE district_list SET region = :region, districts = :districts, number = :number, signed_s = :signed_s,
  signer = :signer, signature = :signature
WHERE layer = :layer AND number = :held

-- name: region_of_store
SELECT region FROM district_owner WHERE district = -1

-- name: districts_moved_away
SELECT district FROM district_owner WHERE district >= 0 AND state = 'moved'

-- name: any_other_head
SELECT 1 FROM tile_head WHERE layer = :layer AND (tile < :first OR tile >= :end) LIMIT 1
