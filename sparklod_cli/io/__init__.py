"""Opens inputs, recognises their formats and reads them; decides which files a scene becomes."""
