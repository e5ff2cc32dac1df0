//! Zip archives whose files are stored, not compressed.

use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;
use std::process::Command;

/// Writes a zip archive of `count` tables. Each has these rows, and then zeros up to `length`
/// bytes, which take no space on the disk.
pub fn write_stored_zip(path: &Path, rows: &[u8], length: u32, count: u16) {
    let checksum = crc_32(path, rows);
    let mut file = File::create(path).unwrap();
    let mut list: Vec<u8> = Vec::new();
    for number in 1..=count {
        let name = format!("m{number}.csv");
        let mut about: Vec<u8> = vec![20, 0]; // version
        about.extend([0; 4]); // flags, and the method of storing
        about.extend([0, 0, 0x21, 0]); // time and date: 1980-01-01
        about.extend(checksum);
        about.extend(length.to_le_bytes());
        about.extend(length.to_le_bytes());
        about.extend((name.len() as u16).to_le_bytes());
        about.extend([0, 0]); // no extra field
        let start = file.stream_position().unwrap();
        let head = [&b"PK\x03\x04"[..], &about[..], name.as_bytes()].concat();
        file.write_all(&head).unwrap();
        file.write_all(rows).unwrap();
        let end = start + head.len() as u64 + u64::from(length);
        file.seek(SeekFrom::Start(end)).unwrap();
        list.extend(b"PK\x01\x02\x14\0");
        list.extend(about);
        list.extend([0; 10]); // no comment, first disk, no attributes
        list.extend((start as u32).to_le_bytes());
        list.extend(name.into_bytes());
    }
    let start = file.stream_position().unwrap() as u32;
    file.write_all(&list).unwrap();
    let mut end = b"PK\x05\x06\0\0\0\0".to_vec();
    end.extend(count.to_le_bytes());
    end.extend(count.to_le_bytes());
    end.extend((list.len() as u32).to_le_bytes());
    end.extend(start.to_le_bytes());
    end.extend([0, 0]); // no comment
    file.write_all(&end).unwrap();
}

/// Returns the checksum of `content`, as it is in the last eight bytes of gzip data.
fn crc_32(path: &Path, content: &[u8]) -> [u8; 4] {
    std::fs::write(path, content).unwrap();
    let packed = Command::new("gzip").arg("-1nc").arg(path).output().unwrap();
    let end = packed.stdout.len();
    packed.stdout[end - 8..end - 4].try_into().unwrap()
}
