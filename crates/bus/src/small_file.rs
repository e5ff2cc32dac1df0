//! Reads files of limited size: settings, secrets, baselines and other files that a person names.
//!
//! Opening a named pipe waits for its writer, and a device has no end. A path with such a file must
//! not stop a service, so only regular files of limited size are opened.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read as _};
use std::path::Path;

/// Maximum size of a small file (bytes).
const MOST_BYTES: u64 = 1 << 20;

/// Checks that a file is a regular file, without opening it.
///
/// # Errors
/// The file does not exist, or it is a folder, a pipe, a device or a socket.
pub fn check_regular_file(path: &Path) -> io::Result<()> {
    match fs::metadata(path)?.is_file() {
        true => Ok(()),
        false => Err(io::Error::new(
            ErrorKind::InvalidInput,
            "is a folder, a pipe, a device or a socket, must be a regular file",
        )),
    }
}

/// Reads a regular file of at most 1 MiB.
///
/// # Errors
/// The file cannot be read, is not a regular file, or is larger.
pub fn read_small_file(path: &Path) -> io::Result<Vec<u8>> {
    read_file_up_to(path, MOST_BYTES)
}

/// Reads a regular file of at most 1 MiB as UTF-8.
///
/// # Errors
/// As for [`read_small_file`], or the content is not UTF-8.
pub fn read_small_text(path: &Path) -> io::Result<String> {
    read_text_up_to(path, MOST_BYTES)
}

/// Reads a regular file of at most `most` bytes as UTF-8.
///
/// # Errors
/// The file cannot be read, is not a regular file, is larger, or its content is not UTF-8.
pub fn read_text_up_to(path: &Path, most: u64) -> io::Result<String> {
    String::from_utf8(read_file_up_to(path, most)?)
        .map_err(|_| io::Error::new(ErrorKind::InvalidData, "is not UTF-8"))
}

fn read_file_up_to(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    check_regular_file(path)?;
    let mut bytes = Vec::new();
    File::open(path)?.take(most + 1).read_to_end(&mut bytes)?;
    match bytes.len() as u64 <= most {
        true => Ok(bytes),
        false => Err(io::Error::new(
            ErrorKind::FileTooLarge,
            format!("has more than {most} bytes, must have at most {most}"),
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_files_are_read_and_all_else_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let in_folder = |name: &str| folder.path().join(name);
        fs::write(in_folder("small"), "a text").unwrap();
        assert_eq!(read_small_text(&in_folder("small")).unwrap(), "a text");
        let large = File::create(in_folder("large")).unwrap();
        large.set_len(MOST_BYTES).unwrap();
        assert_eq!(read_small_file(&in_folder("large")).unwrap().len(), 1 << 20);
        large.set_len(MOST_BYTES + 1).unwrap();
        fs::write(in_folder("binary"), [0xff, 0x00]).unwrap();
        let made = std::process::Command::new("mkfifo")
            .arg(in_folder("pipe"))
            .status();
        assert!(made.unwrap().success());
        let told = |name: &str| read_small_text(&in_folder(name)).unwrap_err().to_string();
        assert_eq!(
            told("large"),
            "has more than 1048576 bytes, must have at most 1048576"
        );
        assert_eq!(told("binary"), "is not UTF-8");
        assert_eq!(read_text_up_to(&in_folder("small"), 6).unwrap(), "a text");
        assert_eq!(
            read_text_up_to(&in_folder("small"), 5)
                .unwrap_err()
                .to_string(),
            "has more than 5 bytes, must have at most 5"
        );
        for name in ["pipe", "/dev/zero", "."] {
            assert_eq!(
                told(name),
                "is a folder, a pipe, a device or a socket, must be a regular file"
            );
        }
        assert_eq!(
            read_small_file(&in_folder("none")).unwrap_err().kind(),
            ErrorKind::NotFound
        );
    }
}
