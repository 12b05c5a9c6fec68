-- A token has a role or rights of its own, and holds everywhere or for some sites and robots. Tokens
-- that there are keep their roles and hold everywhere.
ALTER TABLE tokens ADD COLUMN kept_role TEXT CHECK (kept_role IN ('viewer', 'operator', 'admin'));
UPDATE tokens SET kept_role = role;
ALTER TABLE tokens DROP COLUMN role;
ALTER TABLE tokens RENAME COLUMN kept_role TO role;
-- JSON list of the names of rights.
ALTER TABLE tokens ADD COLUMN rights TEXT CHECK ((role IS NULL) <> (rights IS NULL));
-- JSON list of what it holds for, each `site` or `site/robot`; NULL for everywhere.
ALTER TABLE tokens ADD COLUMN scope TEXT CHECK (scope IS NULL OR json_array_length(scope) > 0);
