//! Paths of files.

use std::path::Path;

/// Returns the folder of a file; the current one for a bare name.
pub(crate) fn folder_of(file: &Path) -> &Path {
    let folder = file.parent().filter(|it| !it.as_os_str().is_empty());
    folder.unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bare_name_is_in_the_current_folder() {
        assert_eq!(folder_of(Path::new("tread.db")), Path::new("."));
        assert_eq!(folder_of(Path::new("data/tread.db")), Path::new("data"));
        assert_eq!(folder_of(Path::new("/tread.db")), Path::new("/"));
    }
}
