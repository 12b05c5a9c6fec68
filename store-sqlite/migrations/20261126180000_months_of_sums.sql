-- Hour since 1970 before which days of measurements are read as calendar months (UTC); the first hour of
-- a month.
ALTER TABLE sites ADD COLUMN months_before_h INTEGER NOT NULL DEFAULT 0
    CHECK (months_before_h <= merged_before_h
        AND strftime('%d %H', months_before_h * 3600, 'unixepoch') = '01 00');
