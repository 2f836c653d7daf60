//! The one error type of the library.

use std::path::PathBuf;

/// `Result` with the crate's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Everything that can go wrong for a reason outside this crate.
///
/// Each message names the place (file, and the spot inside it) and, where that makes sense, what was expected and what was
/// found. Mistakes of this crate are assertions, not errors.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file could not be read or written.
    #[error("{path}: {cause}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        cause: std::io::Error,
    },
    /// A scene file is malformed, or asks for something that is not supported.
    #[error("{path}: {place}: {message}")]
    Scene {
        /// The scene file.
        path: PathBuf,
        /// The spot inside the file, such as `accessors[3].bufferView` or `line 4, column 2`.
        place: String,
        /// Expected and found.
        message: String,
    },
    /// An image file is malformed, or lacks what is asked of it.
    #[error("{path}: {message}")]
    Image {
        /// The image file.
        path: PathBuf,
        /// Expected and found.
        message: String,
    },
    /// Two images that can't be compared.
    #[error("the images can't be compared: {0}")]
    Mismatch(String),
    /// A value given by the user (option, parameter, scene description) can't be used.
    #[error("{what}: {message}")]
    Usage {
        /// The option or parameter.
        what: String,
        /// Expected and found.
        message: String,
    },
    /// The scene has no light, and none was added.
    #[error(
        "{scene} has no light (found {found}); add one with --add-light auto, or for example \
         --add-light rect:at=0/3/0,to=0/0/0,size=1x0.5"
    )]
    NoLight {
        /// The scene's name.
        scene: String,
        /// What the scene does have.
        found: String,
    },
    /// There is no GPU, or it can't do what is asked.
    #[error("GPU: {0}")]
    Gpu(String),
    /// The user asked to stop.
    #[error("cancelled")]
    Cancelled,
}

impl Error {
    /// A user's value that can't be used.
    pub fn usage(what: impl Into<String>, message: impl Into<String>) -> Self {
        Self::Usage { what: what.into(), message: message.into() }
    }

    /// An operating-system error on `path`.
    pub fn io(path: impl Into<PathBuf>, cause: std::io::Error) -> Self {
        Self::Io { path: path.into(), cause }
    }
}
