#![no_main]

splatsieve_fuzz::target!("archive_sections");
