-- A project as version 1 of the schema wrote it: actions 0 to 39 of seed 1. Never change this file.
PRAGMA application_id = 1128354388;
PRAGMA user_version = 1;
PRAGMA journal_mode = WAL;
BEGIN TRANSACTION;
CREATE TABLE changes (            -- what each gesture set
    kind TEXT NOT NULL,
    frame INTEGER NOT NULL,       -- index from 0; -1: all frames
    name TEXT NOT NULL,           -- arm or camera, or nothing
    step INTEGER NOT NULL,
    value BLOB,                   -- JSON text, PNG bytes, or NULL: removed
    UNIQUE (kind, frame, name, step)
);
INSERT INTO "changes" VALUES('ignore_region',2,'left',1,X'89504E470D0A1A0A0000000D4948445200000008000000060800000000DB6E80270000002149444154081D25C1810D00300CC320FCFFD1E9A441586BF9160BCB338985C51A1D2B7F0B033A0927330000000049454E44AE426082');
INSERT INTO "changes" VALUES('review',0,'',2,'{"state": "untouched", "note": ""}');
INSERT INTO "changes" VALUES('review',1,'',3,'{"state": "untouched", "note": ""}');
INSERT INTO "changes" VALUES('ignore_region',0,'left',4,X'89504E470D0A1A0A0000000D4948445200000008000000060800000000DB6E80270000002149444154081D25C1810D00300CC320FCFFD1E9A441586BF9160BCB338985C51A1D2B7F0B033A0927330000000049454E44AE426082');
INSERT INTO "changes" VALUES('joints',2,'PSM2',5,'{"joint_positions": [0.0, 0.001], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}, "standard_deviations": [0.0, 0.001]}');
INSERT INTO "changes" VALUES('ignore_region',1,'left',5,X'89504E470D0A1A0A0000000D4948445200000008000000060800000000DB6E80270000002249444154081D25C1810D00000C8320FDFF68D764604892848C491832194226C9EB00708D0D02FCCED7D30000000049454E44AE426082');
INSERT INTO "changes" VALUES('joints',0,'PSM2',5,'{"joint_positions": [0.0, 0.001], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}, "standard_deviations": [0.0, 0.001]}');
INSERT INTO "changes" VALUES('review',2,'',5,'{"state": "optimized", "note": ""}');
INSERT INTO "changes" VALUES('keyframe',0,'',5,'{"held": true}');
INSERT INTO "changes" VALUES('joints',1,'PSM1',5,'{"joint_positions": [0.1, 0.101, 0.10200000000000001], "provenance": {"source": "optimizer", "settings": "{\"iterations\": 60, \"solver\": \"adam\"}", "weights_sha256": "abababababababababababababababababababababababababababababababab"}, "standard_deviations": [0.1, 0.101, 0.10200000000000001]}');
INSERT INTO "changes" VALUES('joints',2,'PSM1',5,'{"joint_positions": [0.1, 0.101, 0.10200000000000001], "provenance": {"source": "optimizer", "settings": "{\"iterations\": 60, \"solver\": \"adam\"}", "weights_sha256": "abababababababababababababababababababababababababababababababab"}, "standard_deviations": [0.1, 0.101, 0.10200000000000001]}');
INSERT INTO "changes" VALUES('review',0,'',5,'{"state": "needs work", "note": "d\u00fcnn\u0000 \ud800"}');
INSERT INTO "changes" VALUES('keyframe',2,'',5,'{"held": false}');
INSERT INTO "changes" VALUES('keyframe',1,'',5,'{"held": true}');
INSERT INTO "changes" VALUES('mask_correction',0,'left',5,X'89504E470D0A1A0A0000000D4948445200000008000000060800000000DB6E80270000002449444154081D25C1810DC0400800219CDCDBDC36799853C95C0AB322E6229AF5CCFA551F7D4B0C016505DB990000000049454E44AE426082');
INSERT INTO "changes" VALUES('joints',1,'PSM2',5,'{"joint_positions": [0.1, 0.101], "provenance": {"source": "optimizer", "settings": "{\"iterations\": 60, \"solver\": \"adam\"}", "weights_sha256": "abababababababababababababababababababababababababababababababab"}, "standard_deviations": [0.1, 0.101]}');
INSERT INTO "changes" VALUES('ignore_region',2,'left',5,NULL);
INSERT INTO "changes" VALUES('joints',2,'PSM2',6,'{"joint_positions": [0.1, 0.101], "provenance": {"source": "optimizer", "settings": "{\"iterations\": 60, \"solver\": \"adam\"}", "weights_sha256": "abababababababababababababababababababababababababababababababab"}, "standard_deviations": [0.1, 0.101]}');
INSERT INTO "changes" VALUES('review',2,'',6,'{"state": "optimized", "note": "d\u00fcnn\u0000 \ud800"}');
INSERT INTO "changes" VALUES('joints',0,'PSM1',6,'{"joint_positions": [0.1, 0.101, 0.10200000000000001], "provenance": {"source": "optimizer", "settings": "{\"iterations\": 60, \"solver\": \"adam\"}", "weights_sha256": "abababababababababababababababababababababababababababababababab"}, "standard_deviations": [0.1, 0.101, 0.10200000000000001]}');
INSERT INTO "changes" VALUES('joints',1,'PSM1',6,'{"joint_positions": [0.0, 0.001, 0.002], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}, "standard_deviations": [0.0, 0.001, 0.002]}');
INSERT INTO "changes" VALUES('review',1,'',6,NULL);
INSERT INTO "changes" VALUES('base_frame',-1,'PSM1',6,'{"transform": [[1.0, 0.0, 0.0, 0.2], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}}');
INSERT INTO "changes" VALUES('intrinsics',-1,'left',6,'{"intrinsics": [800.0, 800.0, 4.5, 3.0], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}}');
INSERT INTO "changes" VALUES('mask_correction',0,'left',6,X'89504E470D0A1A0A0000000D4948445200000008000000060800000000DB6E80270000002349444154081D0DC18101C0300CC3207C79F4F956D8E961577AF695CA8EA41D4A3B0A3FCBCB0F0196ECB6540000000049454E44AE426082');
INSERT INTO "changes" VALUES('review',0,'',6,'{"state": "needs work", "note": ""}');
INSERT INTO "changes" VALUES('joints',1,'PSM2',6,'{"joint_positions": [0.0, 0.001], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}, "standard_deviations": [0.0, 0.001]}');
INSERT INTO "changes" VALUES('ignore_region',0,'left',6,NULL);
INSERT INTO "changes" VALUES('mask_correction',2,'left',6,X'89504E470D0A1A0A0000000D4948445200000008000000060800000000DB6E80270000002449444154081D25C1810DC0400800219CDCDBDC36799853C95C0AB322E6229AF5CCFA551F7D4B0C016505DB990000000049454E44AE426082');
CREATE TABLE exports (
    time REAL NOT NULL,
    format TEXT NOT NULL,
    path TEXT NOT NULL,
    frames INTEGER NOT NULL,
    settings TEXT NOT NULL        -- JSON
);
INSERT INTO "exports" VALUES(1.79526158129536485674e+09,'coco','out 0',3,'{"polygons": true}');
INSERT INTO "exports" VALUES(1.7952615812972519398e+09,'coco','out 2',3,'{"polygons": true}');
INSERT INTO "exports" VALUES(1.79526158132141923904e+09,'coco','out 7',3,'{"polygons": true}');
CREATE TABLE figures (            -- computed for a frame as step `revision` had left it
    frame INTEGER NOT NULL,
    revision INTEGER NOT NULL,
    loss REAL,
    dice REAL,
    PRIMARY KEY (frame, revision)
);
INSERT INTO "figures" VALUES(2,0,1.42844896242012131537e-01,NULL);
INSERT INTO "figures" VALUES(0,0,6.5151929750324166779e-01,NULL);
INSERT INTO "figures" VALUES(2,1,3.59780303210592511398e-01,NULL);
INSERT INTO "figures" VALUES(0,4,9.7282299483686140995e-01,6.97499847871125622233e-01);
INSERT INTO "figures" VALUES(1,5,8.57536467619688602681e-01,2.38613974909804404944e-01);
INSERT INTO "figures" VALUES(0,6,8.78254113264529401305e-02,NULL);
CREATE TABLE project (            -- one row
    identity TEXT NOT NULL,       -- of the sequence, JSON
    position INTEGER NOT NULL,    -- how many steps are done; those after it are undone
    created REAL NOT NULL         -- seconds since 1970, as all times
);
INSERT INTO "project" VALUES('{"name": "small", "frame_ids": ["001", "002", "003"], "arms": {"PSM1": ["yaw", "pitch", "insertion"], "PSM2": ["yaw", "pitch"]}, "cameras": {"left": [8, 6]}, "kinematics_sha256": "0000000000000000000000000000000000000000000000000000000000000000"}',6,1.79526158126530814172e+09);
CREATE TABLE steps (              -- one per gesture
    step INTEGER PRIMARY KEY,     -- 1, 2, 3, ...
    name TEXT NOT NULL,
    time REAL NOT NULL
);
INSERT INTO "steps" VALUES(1,'edit 21',1.7952615813612987995e+09);
INSERT INTO "steps" VALUES(2,'edit 25',1.79526158138129711154e+09);
INSERT INTO "steps" VALUES(3,'edit 28',1.79526158138241696358e+09);
INSERT INTO "steps" VALUES(4,'edit 30',1.79526158138929557801e+09);
INSERT INTO "steps" VALUES(5,'edit 33',1.79526158139727878568e+09);
INSERT INTO "steps" VALUES(6,'edit 38',1.79526158140957283978e+09);
CREATE INDEX changes_by_step ON changes (step);
CREATE VIEW current AS            -- the last change of every value that is done
    SELECT kind, frame, name, step, value FROM changes JOIN (
        SELECT kind, frame, name, max(step) AS step FROM changes
        WHERE step <= (SELECT position FROM project) GROUP BY kind, frame, name
    ) USING (kind, frame, name, step);
COMMIT;
