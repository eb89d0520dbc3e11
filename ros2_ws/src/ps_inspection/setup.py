from glob import glob

from setuptools import find_packages, setup

package_name = 'ps_inspection'

setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(exclude=['test']),
    package_data={package_name: ['py.typed', 'data/*', 'templates/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/config', glob('config/*.*')),
        ('share/' + package_name + '/config/security', glob('config/security/*')),
        ('share/' + package_name + '/launch', glob('launch/*.launch.py')),
    ],
    install_requires=['setuptools'],
    extras_require={'cluster': ['distributed']},     # ps_session reconstruct --scheduler
    zip_safe=True,
    maintainer='ps_head maintainers',
    maintainer_email='maintainers@ps-head.invalid',
    description='The inspection cell: launch, configuration, sessions, demo.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'inspection = ps_inspection.nodes.inspection:main',
            'session_recorder = ps_inspection.nodes.session_recorder:main',
            'ps_cell = ps_inspection.cli.ps_cell:main',
            'ps_demo = ps_inspection.cli.ps_demo:main',
            'ps_session = ps_inspection.cli.ps_session:main',
        ],
    },
)
