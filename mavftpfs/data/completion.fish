
# -- ours --------------------------------------------------------------------------------------------

set -g _mavftpfs_words @WORDS@
set -g _mavftpfs_values @VALUES@

# What may follow in the list behind -o
function _mavftpfs_options
  set -l typed (commandline -ct)
  set -l last (string replace -r '.*,' '' -- $typed)
  set -l before (string sub -l (math (string length -- "$typed") - (string length -- "$last")) -- "$typed")
  set -l name (string replace -r '=.*' '' -- $last)
  if contains -- "$name=" @FILES@; and string match -q '*=*' -- $last
    set -l place (string replace -r '^[^=]*=' '' -- $last)
    for path in (__fish_complete_path $place)
      printf '%s%s=%s\n' $before $name $path
    end
  else if string match -q '*=*' -- $last
    printf "$before%s\n" $_mavftpfs_values
  else
    printf "$before%s\n" $_mavftpfs_words
  end
end

# `SOURCE MOUNTPOINT` without a command is `mount SOURCE MOUNTPOINT`.
functions -q _mavftpfs_scan; or functions --copy _shtab_mavftpfs_scan _mavftpfs_scan
function _shtab_mavftpfs_scan
  _mavftpfs_scan
  if test -z "$_shtab_mavftpfs_cmdpath"; and test $_shtab_mavftpfs_npos -gt 0
    set -g _shtab_mavftpfs_cmdpath mount
  end
end

complete -c mavftpfs -n '_shtab_mavftpfs_using; and test $_shtab_mavftpfs_npos -eq 0' -a '(__fish_complete_path (commandline -ct))'
