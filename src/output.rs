//! Output files that are whole or not there.

use std::fs::{self, File};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use tempfile::NamedTempFile;

use crate::{Error, Result};

/// Writes `path` through `write`: into a temporary file beside it that takes its place once everything is on disk, and
/// that is removed when `write` fails (a cancellation is such a failure). What was at `path` before stays until then.
///
/// The file gets the permissions of any new file, or those of the one it replaces; a symbolic link stays and its target is
/// replaced. A device or a pipe is written to directly.
pub fn write_atomically(path: &Path, write: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<()> {
    prepare(path, write)?.commit()
}

/// A file that is written and on disk but not yet in its place; dropped, it leaves nothing.
#[derive(Debug)]
pub struct Prepared {
    /// None for a device or a pipe, which has been written to.
    file: Option<(NamedTempFile, Unfinished)>,
    path: PathBuf,
    target: PathBuf,
}

/// The first half of [`write_atomically`], for files that take their places together.
pub fn prepare(path: &Path, write: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<Prepared> {
    let failed = |cause| Error::io(path, cause);
    let existing = check(path)?;
    if existing.as_ref().is_some_and(|metadata| !metadata.is_file()) {
        let mut file = BufWriter::new(File::options().write(true).open(path).map_err(failed)?);
        write(&mut file)?;
        file.flush().map_err(failed)?;
        return Ok(Prepared { file: None, path: path.to_path_buf(), target: path.to_path_buf() });
    }
    let target = if existing.is_some() { fs::canonicalize(path).map_err(failed)? } else { path.to_path_buf() };
    let directory = directory_of(&target);
    let mut builder = tempfile::Builder::new();
    builder.prefix(".penumbra-").suffix(".part");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        // What File::create asks for; the process's umask applies.
        builder.permissions(fs::Permissions::from_mode(0o666));
    }
    // An error from tempfile names its own random path; the user's is the one that helps.
    let create = |error: io::Error| {
        let message = format!("can't create a file in {}: {}", directory.display(), reason(&error));
        failed(io::Error::new(error.kind(), message))
    };
    let file = builder.tempfile_in(&directory).map_err(create)?;
    let unfinished = Unfinished::new(file.path());
    let mut file = BufWriter::new(file);
    write(&mut file)?;
    let file = file.into_inner().map_err(|error| failed(error.into_error()))?;
    if let Some(metadata) = existing {
        fs::set_permissions(file.path(), metadata.permissions()).map_err(failed)?;
    }
    // A full disk or a failing network mount reports here, before the old file is gone.
    file.as_file().sync_all().map_err(failed)?;
    Ok(Prepared { file: Some((file, unfinished)), path: path.to_path_buf(), target })
}

impl Prepared {
    /// Puts the file into its place.
    pub fn commit(self) -> Result<()> {
        if let Some((file, _unfinished)) = self.file {
            file.persist(&self.target).map_err(|error| Error::io(self.path, error.error))?;
        }
        Ok(())
    }
}

/// Whether `path` can be written, as far as can be told beforehand; what is there already.
pub fn check(path: &Path) -> Result<Option<fs::Metadata>> {
    let refused = |kind, message: String| Err(Error::io(path, io::Error::new(kind, message)));
    match fs::metadata(path) {
        Ok(metadata) if metadata.is_dir() => {
            refused(ErrorKind::IsADirectory, "is a directory; expected a file name".into())
        }
        Ok(metadata) if metadata.permissions().readonly() => {
            refused(ErrorKind::PermissionDenied, "exists and is read-only".into())
        }
        Ok(metadata) => Ok(Some(metadata)),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let directory = directory_of(path);
            if directory.is_dir() {
                return Ok(None);
            }
            refused(ErrorKind::NotFound, format!("the directory {} does not exist", directory.display()))
        }
        Err(error) => Err(Error::io(path, error)),
    }
}

/// Temporary files of writes in progress.
static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Removes the temporary files of writes in progress: for a process that is about to end in the middle of its work.
pub fn remove_unfinished() {
    for path in unfinished().drain(..) {
        // Already renamed or gone: nothing is left behind either way.
        let _ = fs::remove_file(path);
    }
}

fn unfinished() -> MutexGuard<'static, Vec<PathBuf>> {
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Lists a temporary file for as long as it is there.
#[derive(Debug)]
struct Unfinished(PathBuf);

impl Unfinished {
    fn new(path: &Path) -> Self {
        unfinished().push(path.to_path_buf());
        Self(path.to_path_buf())
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        unfinished().retain(|path| *path != self.0);
    }
}

fn directory_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent.to_path_buf(),
        _ => PathBuf::from("."),
    }
}

fn reason(error: &io::Error) -> String {
    match error.raw_os_error() {
        Some(code) => io::Error::from_raw_os_error(code).to_string(),
        None => error.kind().to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries(directory: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    fn hello(file: &mut dyn Write) -> Result<()> {
        file.write_all(b"hello").map_err(|error| Error::io("", error))
    }

    #[test]
    fn finished_file_takes_its_place_and_leaves_nothing_beside() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("out.bin");
        write_atomically(&path, hello).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"hello");
        assert_eq!(entries(directory.path()), ["out.bin"]);
    }

    #[test]
    fn cancelled_write_keeps_the_old_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("out.bin");
        fs::write(&path, b"old").unwrap();
        let result = write_atomically(&path, |file| {
            hello(file)?;
            Err(Error::Cancelled)
        });
        assert!(matches!(result, Err(Error::Cancelled)));
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(entries(directory.path()), ["out.bin"]);
    }

    #[test]
    fn missing_directory_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("none/out.bin");
        let message = write_atomically(&path, hello).unwrap_err().to_string();
        assert!(message.contains("none does not exist"), "{message}");
        let message = write_atomically(directory.path(), hello).unwrap_err().to_string();
        assert!(message.contains("is a directory"), "{message}");
    }

    #[cfg(unix)]
    #[test]
    fn permissions_are_those_of_an_ordinary_file() {
        use std::os::unix::fs::PermissionsExt;
        let directory = tempfile::tempdir().unwrap();
        let (ordinary, ours) = (directory.path().join("ordinary"), directory.path().join("ours"));
        fs::write(&ordinary, b"").unwrap();
        write_atomically(&ours, hello).unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&ours), mode(&ordinary));
        fs::set_permissions(&ours, fs::Permissions::from_mode(0o640)).unwrap();
        write_atomically(&ours, hello).unwrap();
        assert_eq!(mode(&ours) & 0o777, 0o640);
    }

    #[cfg(unix)]
    #[test]
    fn symbolic_link_stays_a_link() {
        let directory = tempfile::tempdir().unwrap();
        let (target, link) = (directory.path().join("target"), directory.path().join("link"));
        fs::write(&target, b"old").unwrap();
        std::os::unix::fs::symlink(&target, &link).unwrap();
        write_atomically(&link, hello).unwrap();
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(fs::read(&target).unwrap(), b"hello");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn full_device_is_an_error_and_devices_are_not_replaced() {
        use std::os::unix::fs::FileTypeExt;
        let message = write_atomically(Path::new("/dev/full"), hello).unwrap_err().to_string();
        assert!(message.starts_with("/dev/full: No space left"), "{message}");
        write_atomically(Path::new("/dev/null"), hello).unwrap();
        assert!(fs::metadata("/dev/null").unwrap().file_type().is_char_device());
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn unwritable_place_is_named() {
        let message = write_atomically(Path::new("/proc/out.bin"), hello).unwrap_err().to_string();
        assert!(message.starts_with("/proc/out.bin: can't create a file in /proc: "), "{message}");
    }
}
