-- A project as version 1 of the schema wrote it: actions 0 to 39 of seed 216. Never change this file.
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
INSERT INTO "changes" VALUES('review',1,'',1,'{"state": "accepted", "note": ""}');
INSERT INTO "changes" VALUES('review',0,'',2,'{"state": "optimized", "note": "d\u00fcnn\u0000 \ud800"}');
INSERT INTO "changes" VALUES('review',0,'',3,'{"state": "untouched", "note": "d\u00fcnn\u0000 \ud800"}');
INSERT INTO "changes" VALUES('review',2,'',3,'{"state": "optimized", "note": ""}');
INSERT INTO "changes" VALUES('keyframe',0,'',4,'{"held": true}');
INSERT INTO "changes" VALUES('review',2,'',5,'{"state": "needs work", "note": "d\u00fcnn\u0000 \ud800"}');
INSERT INTO "changes" VALUES('base_frame',-1,'PSM2',6,'{"transform": [[1.0, 0.0, 0.0, 0.2], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}}');
INSERT INTO "changes" VALUES('joints',2,'PSM1',7,'{"joint_positions": [0.1, 0.101, 0.10200000000000001], "provenance": {"source": "optimizer", "settings": "{\"iterations\": 60, \"solver\": \"adam\"}", "weights_sha256": "abababababababababababababababababababababababababababababababab"}, "standard_deviations": [0.1, 0.101, 0.10200000000000001]}');
INSERT INTO "changes" VALUES('review',2,'',7,'{"state": "untouched", "note": "d\u00fcnn\u0000 \ud800"}');
INSERT INTO "changes" VALUES('mask_correction',2,'left',8,X'89504E470D0A1A0A0000000D4948445200000008000000060800000000DB6E80270000002449444154081D25C1810DC0400800219CDCDBDC36799853C95C0AB322E6229AF5CCFA551F7D4B0C016505DB990000000049454E44AE426082');
INSERT INTO "changes" VALUES('intrinsics',-1,'left',8,'{"intrinsics": [800.0, 800.0, 4.5, 3.0], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}}');
INSERT INTO "changes" VALUES('extrinsics',-1,'left',8,'{"transform": [[1.0, 0.0, 0.0, 0.3], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}}');
INSERT INTO "changes" VALUES('mask_correction',0,'left',8,X'89504E470D0A1A0A0000000D4948445200000008000000060800000000DB6E80270000002349444154081D0DC18101C0300CC3207C79F4F956D8E961577AF695CA8EA41D4A3B0A3FCBCB0F0196ECB6540000000049454E44AE426082');
INSERT INTO "changes" VALUES('keyframe',2,'',8,'{"held": true}');
INSERT INTO "changes" VALUES('joints',2,'PSM1',8,NULL);
INSERT INTO "changes" VALUES('joints',2,'PSM2',8,'{"joint_positions": [0.1, 0.101], "provenance": {"source": "optimizer", "settings": "{\"iterations\": 60, \"solver\": \"adam\"}", "weights_sha256": "abababababababababababababababababababababababababababababababab"}, "standard_deviations": [0.1, 0.101]}');
INSERT INTO "changes" VALUES('joints',0,'PSM1',8,'{"joint_positions": [0.0, 0.001, 0.002], "provenance": {"source": "hand", "settings": null, "weights_sha256": null}, "standard_deviations": [0.0, 0.001, 0.002]}');
INSERT INTO "changes" VALUES('review',1,'',8,'{"state": "rejected", "note": "d\u00fcnn\u0000 \ud800"}');
INSERT INTO "changes" VALUES('joints',1,'PSM2',9,'{"joint_positions": [0.1, 0.101], "provenance": {"source": "optimizer", "settings": "{\"iterations\": 60, \"solver\": \"adam\"}", "weights_sha256": "abababababababababababababababababababababababababababababababab"}, "standard_deviations": [0.1, 0.101]}');
INSERT INTO "changes" VALUES('review',0,'',10,NULL);
INSERT INTO "changes" VALUES('ignore_region',2,'left',11,X'89504E470D0A1A0A0000000D4948445200000008000000060800000000DB6E80270000002149444154081D25C1810D00300CC320FCFFD1E9A441586BF9160BCB338985C51A1D2B7F0B033A0927330000000049454E44AE426082');
INSERT INTO "changes" VALUES('joints',2,'PSM2',12,NULL);
CREATE TABLE exports (
    time REAL NOT NULL,
    format TEXT NOT NULL,
    path TEXT NOT NULL,
    frames INTEGER NOT NULL,
    settings TEXT NOT NULL        -- JSON
);
INSERT INTO "exports" VALUES(1.79526234725719547268e+09,'coco','out 5',3,'{"polygons": true}');
INSERT INTO "exports" VALUES(1.79526234727719259266e+09,'coco','out 10',3,'{"polygons": true}');
INSERT INTO "exports" VALUES(1.79526234728708815576e+09,'coco','out 16',3,'{"polygons": true}');
INSERT INTO "exports" VALUES(1.79526234730521464348e+09,'coco','out 24',3,'{"polygons": true}');
INSERT INTO "exports" VALUES(1.79526234731832313538e+09,'coco','out 37',3,'{"polygons": true}');
CREATE TABLE figures (            -- computed for a frame as step `revision` had left it
    frame INTEGER NOT NULL,
    revision INTEGER NOT NULL,
    loss REAL,
    dice REAL,
    PRIMARY KEY (frame, revision)
);
INSERT INTO "figures" VALUES(1,0,4.7633028502459540121e-01,NULL);
INSERT INTO "figures" VALUES(0,0,9.14040616390958793324e-01,NULL);
INSERT INTO "figures" VALUES(2,0,3.53992181636568647995e-01,NULL);
INSERT INTO "figures" VALUES(0,8,2.73391796624753213862e-01,NULL);
INSERT INTO "figures" VALUES(2,11,3.74480870627561190921e-01,4.60565178916322426339e-01);
INSERT INTO "figures" VALUES(2,12,6.46141321502985310765e-01,NULL);
INSERT INTO "figures" VALUES(1,9,7.70846224890631259718e-01,2.25440739708495652138e-02);
CREATE TABLE project (            -- one row
    identity TEXT NOT NULL,       -- of the sequence, JSON
    position INTEGER NOT NULL,    -- how many steps are done; those after it are undone
    created REAL NOT NULL         -- seconds since 1970, as all times
);
INSERT INTO "project" VALUES('{"name": "small", "frame_ids": ["001", "002", "003"], "arms": {"PSM1": ["yaw", "pitch", "insertion"], "PSM2": ["yaw", "pitch"]}, "cameras": {"left": [8, 6]}, "kinematics_sha256": "0000000000000000000000000000000000000000000000000000000000000000"}',11,1.79526234720233893397e+09);
CREATE TABLE steps (              -- one per gesture
    step INTEGER PRIMARY KEY,     -- 1, 2, 3, ...
    name TEXT NOT NULL,
    time REAL NOT NULL
);
INSERT INTO "steps" VALUES(1,'edit 7',1.79526234726528310771e+09);
INSERT INTO "steps" VALUES(2,'edit 9',1.79526234727090167999e+09);
INSERT INTO "steps" VALUES(3,'edit 17',1.7952623472875981331e+09);
INSERT INTO "steps" VALUES(4,'edit 19',1.79526234729466342924e+09);
INSERT INTO "steps" VALUES(5,'edit 20',1.79526234729736399644e+09);
INSERT INTO "steps" VALUES(6,'edit 21',1.79526234729807972903e+09);
INSERT INTO "steps" VALUES(7,'edit 22',1.79526234729869556424e+09);
INSERT INTO "steps" VALUES(8,'edit 26',1.79526234730592489236e+09);
INSERT INTO "steps" VALUES(9,'edit 27',1.79526234730917739869e+09);
INSERT INTO "steps" VALUES(10,'edit 28',1.79526234731232714652e+09);
INSERT INTO "steps" VALUES(11,'edit 29',1.79526234731451058389e+09);
INSERT INTO "steps" VALUES(12,'edit 35',1.79526234731727766993e+09);
CREATE INDEX changes_by_step ON changes (step);
CREATE VIEW current AS            -- the last change of every value that is done
    SELECT kind, frame, name, step, value FROM changes JOIN (
        SELECT kind, frame, name, max(step) AS step FROM changes
        WHERE step <= (SELECT position FROM project) GROUP BY kind, frame, name
    ) USING (kind, frame, name, step);
COMMIT;
