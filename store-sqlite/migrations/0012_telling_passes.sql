-- When the pass that a sum keeps by itself ended: it need not be the newest one. A pass that says
-- next to nothing does not take the place of one that does.

ALTER TABLE cell_sums ADD COLUMN pass_at_us INTEGER NOT NULL DEFAULT 0;

UPDATE cell_sums SET pass_at_us = newest_at_us;
