-- When a stopped robot was measured to stand: a confirmation says only that its wheels were told to.
ALTER TABLE stops ADD COLUMN standing_at_us INTEGER;
