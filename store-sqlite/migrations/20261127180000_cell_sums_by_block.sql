-- Blocks of 64 × 64 cells of the map are read one by one: `>>` rounds down also below 0.
CREATE INDEX cell_sums_of_block ON cell_sums (site_pk, (iy >> 6), (ix >> 6));
